"""``report.md`` and ``tables.tex``: the report's numbers as Markdown and as LaTeX (booktabs).

Both render the `Table` values of `testbed.report.tables`; units stand in the column heads.
"""

from __future__ import annotations

import re

from testbed.report import conditions, innovations, provenance, satellites, tables
from testbed.report.headline import headline
from testbed.report.labels import window_label
from testbed.report.results import Result
from testbed.report.sensors import sensor_tables
from testbed.report.tables import Cell, Column, Table


def markdown(result: Result, figures: dict[str, str]) -> str:
    """The whole report. ``figures`` maps a file name in ``figures/`` to its caption."""
    parts = [f"# {result.title}"]
    if result.source:
        parts.append(f"*{result.source}*")
    if result.changed:
        parts.append(f"Changed: {result.changed}")
    parts.append(" ".join(headline(result).sentences))
    if result.findings:
        parts.append("## Findings\n\n" + _demote(result.findings.strip()))
    shown = [comparison_windows(result)[0]] if result.windows else []
    parts += ["## Comparison"] + [markdown_table(tables.comparison(result, w)) for w in shown]
    if (table := tables.failures(result)) is not None:
        parts += [f"## {table.title}", markdown_table(table)]
    for table in tables.claims(result):
        parts += [f"## {table.title}", markdown_table(table)]
    for table in tables.paper_tables(result):
        parts += [f"## {table.title}", markdown_table(table)]
    if (table := conditions.table(result)) is not None:
        parts += [f"## {table.title}", markdown_table(table)]
    others = comparison_windows(result)[1:]
    if others:
        parts.append("## Other windows")
        parts += [f"### {window_label(w)}\n\n" + markdown_table(tables.comparison(result, w)) for w in others]
    if figures:
        parts += ["## Figures"] + [f"![{caption}](figures/{name})\n\n*{caption}*" for name, caption in figures.items()]
    optional = (tables.consistency(result), innovations.table(result), satellites.table(result), tables.timings(result))
    for table in optional:
        if table is not None:
            parts += [f"## {table.title}", markdown_table(table)]
    if sensors := sensor_tables(result):
        parts.append("## Sensors")
        parts += [f"### {t.title}\n\n" + markdown_table(t) for t in sensors]
    parts.append("## Provenance\n\n" + "\n".join(f"- {name}: {value}" for name, value in provenance.rows(result)))
    parts.append("```\n" + provenance.command(result) + "\n```")
    return "\n\n".join(parts) + "\n"


def comparison_windows(result: Result) -> list[str]:
    """Windows in the order shown: the headline's first."""
    first = headline(result).window
    return sorted(result.windows, key=lambda w: (w != first, w != "all"))


def _demote(text: str) -> str:
    """Findings' headings sink below the report's own."""
    return "\n".join("#" + line if line.startswith("#") else line for line in text.splitlines())


def markdown_table(table: Table) -> str:
    heads = [table.corner or " "] + [_head(c) for c in table.columns]
    rule = [":---"] + ["---:" if c.numeric else ":---" for c in table.columns]
    lines = ["| " + " | ".join(heads) + " |", "| " + " | ".join(rule) + " |"]
    for name, cells in table.rows:
        lines.append("| " + " | ".join([_bar(name), *(_markdown_cell(c) for c in cells)]) + " |")
    return "\n".join(lines) + (f"\n\n{table.note}" if table.note else "")


def _markdown_cell(cell: Cell) -> str:
    text = f"**{cell.text}**" if cell.best or cell.kind else cell.text
    return _bar(f"{text} ({cell.interval})" if cell.interval else text)


def _head(column: Column) -> str:
    words = f"{column.group}: {column.label}" if column.group else column.label
    return _bar(f"{words}, {column.unit}" if column.unit else words)


def _bar(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def latex(result: Result) -> str:
    """Tables for ``\\input``: comparison per window, claims, the paper's tables, consistency, time. Needs booktabs."""
    found = [tables.comparison(result, w) for w in comparison_windows(result)]
    optional = (tables.consistency(result), innovations.table(result), satellites.table(result), tables.timings(result))
    found += tables.claims(result) + [table for table in optional if table is not None]
    found += tables.paper_tables(result)
    return "% needs \\usepackage{booktabs}\n\n" + "\n".join(latex_table(result.name, t) for t in found)


def latex_table(name: str, table: Table) -> str:
    """One table; its label begins with ``name``."""
    layout = "l" + "".join("r" if c.numeric else "p{5cm}" if c.label == "Claim" else "l" for c in table.columns)
    lines = [
        "\\begin{table}[htbp]",
        "  \\centering\\footnotesize\\setlength{\\tabcolsep}{4pt}",
        f"  \\caption{{{_escape(f'{table.title}. {table.note}')}}}",
    ]
    key = re.sub(r"[^A-Za-z0-9.:_-]", "-", f"{name}-{table.key}")  # in a label nothing can be escaped
    lines += [f"  \\label{{tab:{key}}}", f"  \\begin{{tabular}}{{{layout}}}", "    \\toprule"]
    lines += [*_latex_heads(table), "    \\midrule"]
    for row, cells in table.rows:
        lines.append("    " + " & ".join([_escape(row), *(_latex_cell(c) for c in cells)]) + " \\\\")
    return "\n".join([*lines, "    \\bottomrule", "  \\end{tabular}", "\\end{table}", ""])


def _latex_heads(table: Table) -> list[str]:
    lines = []
    if any(c.group for c in table.columns):
        groups: list[tuple[str, int]] = []
        for column in table.columns:
            if groups and groups[-1][0] == column.group:
                groups[-1] = (column.group, groups[-1][1] + 1)
            else:
                groups.append((column.group, 1))
        lines.append("    & " + " & ".join(f"\\multicolumn{{{n}}}{{c}}{{{_escape(g)}}}" for g, n in groups) + " \\\\")
    heads = [f"{c.label} ({c.unit})" if c.unit else c.label for c in table.columns]
    return [*lines, "    " + " & ".join(_escape(h) for h in [table.corner, *heads]) + " \\\\"]


def _latex_cell(cell: Cell) -> str:
    return f"\\textbf{{{_escape(cell.text)}}}" if cell.best else _escape(cell.text)


def _escape(text: str) -> str:
    swaps = {
        "\\": "\\textbackslash{}",
        "{": "\\{",
        "}": "\\}",
        "%": "\\%",
        "&": "\\&",
        "_": "\\_",
        "#": "\\#",
        "$": "\\$",
    }
    swaps |= {
        "~": "\\textasciitilde{}",
        "^": "\\textasciicircum{}",
        "°": "$^\\circ$",
        "µ": "$\\mu$",
        "−": "$-$",
        "±": "$\\pm$",
    }
    swaps |= {
        "–": "--",
        "“": "``",
        "”": "''",
        "\u202f": "\\,",
        "√": "$\\sqrt{}$",
        "²": "$^2$",
        "³": "$^3$",
        "×": "$\\times$",
    }
    return "".join(swaps.get(c, c) for c in text)
