"""Reference pages on what is compared: entries of the league, and the papers' verdicts."""

from __future__ import annotations

from pathlib import Path

from extensions.rst import code, heading, plain, shortened, table

REPORTS = Path(__file__).resolve().parents[2] / "reports"


def league() -> str:
    """The keys of an entry of the league, and the rows that ship."""
    from testbed.league.entry import EntryTable, shipped_entries
    from testbed.scenario.explain import keys

    text = heading("Entries of the league") + "What can stand in an ``entry.toml`` (:doc:`/howto/league`).\n\n"
    rows = []
    for key in keys(EntryTable):
        first, point, rest = key.path.partition(".")
        name = f"{EntryTable.model_fields[first].alias or first}{point}{rest}"
        rows.append((code(name), plain(key.takes), shortened(key.default), plain(key.meaning)))
    text += table(("key", "takes", "default", "meaning"), rows, "22 18 14 46")
    text += heading("Rows that ship", "-")
    shipped = [(code(e.name), e.table.filters, e.table.speed, e.how, plain(e.table.source)) for e in shipped_entries()]
    return text + table(("row", "class", "speed", "run as", "source"), shipped, "20 12 12 20 36")


def verdicts() -> str:
    """The claims of every paper and what became of them, from the tables of ``reports/``."""
    import csv
    import tomllib

    text = heading("Verdicts")
    text += (
        "From the tables in ``reports/``, claim by claim: the improvement that the source states, the lowest and the highest that was "
        "measured here under the readings of what it leaves open, and the class.\n\n"
    )
    for path in sorted(REPORTS.glob("*/claims.csv")):
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        if not rows or "class" not in rows[0]:
            continue
        scenario = REPORTS.parent / "scenarios" / f"{path.parent.name}.toml"
        head = tomllib.loads(scenario.read_text(encoding="utf-8")).get("scenario", {}) if scenario.is_file() else {}
        text += heading(path.parent.name, "-") + plain(head.get("title", "")) + "\n\n"
        shown = [
            (
                plain(r["text"]),
                r["stated_pct"] or "–",
                f"{_pct(r['lowest_pct'])} to {_pct(r['highest_pct'])}",
                f"**{r['class']}**",
                plain(r["where"]),
            )
            for r in rows
        ]
        text += table(("claim", "stated %", "measured %", "class", "where"), shown, "30 8 14 14 34")
    return text


def _pct(value: str) -> str:
    return f"{float(value):.1f}" if value else "–"
