"""A paper's page from what git holds of it: findings, classes of the claims, verdicts by reading, the paper's tables, the jobs' tables.

``report.md`` names no commit, as it is made again byte for byte at any commit that computes the same; the HTML page names its own
and, from ``made.json``, that of each table. Effects in per cent.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jobs import Job, Paper, Setting, read_table, write_csv

if TYPE_CHECKING:
    import pandas as pd

    from testbed.report.tables import Table
    from testbed.scenario import Scenario

CLAIMS = "claims.csv"
SHOWN_ROWS = 60
"""A longer table is a file beside the page, and the page shows its first rows."""
CLASSES = ("holds", "fails", "depends on", "source inconsistent", "open")


def write_claims(paper: Paper, folder: Path) -> pd.DataFrame | None:
    """``claims.csv``: one row per claim with its class and where it holds; None where no verdicts are there.

    From the jobs' tables of verdicts; sentences are those of `testbed.scoring.readings` for claims of a scenario, and for a study's own
    claims the verdicts themselves. Verdicts on computing time depend on the machine and stand in ``timings.md``.
    """
    import pandas as pd

    rows = []
    for job in paper.jobs:
        known = scenario_claims(job.setting, paper.name) if job.setting is not None else {}
        for name in [name for name in job.tables if "verdicts" in name and (folder / name).is_file()]:
            for claim, part in read_table(folder / name).groupby("claim", sort=False):
                text, told = known.get(claim, (part.iloc[0].get("text", claim), told_by_verdict))
                word, sentence = told(part)
                number = str(claim) if job.name in ("readings", "verdicts") or not known else f"{job.name}/{claim}"
                rows.append(row_of_claim(part, number, text) | {"as_tested": word, "where": sentence})
    if not rows:
        return None
    table = pd.DataFrame(rows)
    write_csv(folder / CLAIMS, table)
    return table


def row_of_claim(part: pd.DataFrame, number: str, text: str) -> dict[str, Any]:
    """A claim's verdicts under all readings as one row."""
    first = part.iloc[0]
    row = {"claim": number, "origin": first["origin"], "text": text, "stated_pct": first["stated_pct"]}
    row |= {"margin_pct": first.get("margin_pct"), "lowest_pct": part["effect_pct"].min()}
    return row | {"highest_pct": part["effect_pct"].max(), "readings": len(part), "class": first["class"]}


def scenario_claims(setting: Setting, paper: str) -> dict[str, tuple[str, Any]]:
    """Of a scenario's claims: text, and what makes class (whatever the source contradicts) and sentence of verdicts by reading."""
    from testbed.scoring.readings import standing

    scenario = setting.load(paper)

    def sentence(claim: Any) -> Any:
        def told(part: pd.DataFrame) -> tuple[str, str]:
            found = dict(zip(part["reading"], part["verdict"], strict=True))
            readings = [r for r in scenario.readings if r.name in found]
            return standing(readings, found).word, standing(readings, found, claim.contradiction).sentence

        return told

    return {claim.id or str(k): (claim.text, sentence(claim)) for k, claim in enumerate(scenario.active_claims(), 1)}


def told_by_verdict(part: pd.DataFrame) -> tuple[str, str]:
    """Class (of the verdicts, whatever the source contradicts), and which readings came to which verdict."""
    from testbed.scoring.claims import ReadingConfig
    from testbed.scoring.readings import INCONSISTENT, standing

    words = []
    for verdict, rows in part.groupby("verdict", sort=False):
        words.append(f"{verdict}: {', '.join(rows['reading'])}")
    word = part.iloc[0]["class"]
    if word == INCONSISTENT:
        found = dict(zip(part["reading"], part["verdict"], strict=True))
        word = standing([ReadingConfig(name=name, leaves_open=name) for name in found], found).word
    return word, "; ".join(words)


def class_of(word: str) -> str:
    """One of `CLASSES`."""
    found = next((kind for kind in CLASSES if word.startswith(kind)), "open")
    return "open" if word == "depends on runaways" else found


def write_report(paper: Paper, folder: Path) -> str:
    """``report.md``; returns its text."""
    parts = [f"# {paper.title}", *([f"*{paper.source}*"] if paper.source else [])]
    findings = folder / "findings.md"
    if findings.is_file():
        parts.append(findings.read_text().strip())
    claims = read_table(folder / CLAIMS) if (folder / CLAIMS).is_file() else None
    if claims is not None:
        parts += ["## Claims", markdown(classes(claims))]
    for job in paper.jobs:
        parts += job_parts(paper, job, folder)
    budget = "; ".join(
        f"{job.name} {job.minutes:g}{' (with --long)' if job.long else ''}"
        + ("" if all((folder / name).is_file() for name in job.tables) else ", **not made yet**")
        for job in paper.jobs
    )
    parts.append(
        f"## How it was made\n\n`python reports/make.py {paper.name}`; minutes on two cores at most: {budget}. Which commit made "
        "which table stands in [made.json](made.json)"
        + (", computing times in [timings.md](timings.md)." if (folder / "timings.md").is_file() else ".")
    )
    text = "\n\n".join(parts) + "\n"
    (folder / "report.md").write_text(text)
    return text


def classes(claims: pd.DataFrame) -> Table:
    """Text, stated figure, range of the effects, class and where it holds."""
    from testbed.report.labels import percent
    from testbed.report.tables import Cell, Column, Table

    names = ("Claim", "Whose", "Stated, %", "Effects, %", "Class", "Where")
    columns = [Column(name, numeric=name.endswith("%")) for name in names]
    rows = []
    for row in claims.to_dict("records"):
        stated = percent(row["stated_pct"]) if row["stated_pct"] == row["stated_pct"] else "–"
        if row["margin_pct"] == row["margin_pct"] and row["margin_pct"] is not None:
            stated = f"equal ± {row['margin_pct']:g}"
        ends = dict.fromkeys(percent(row[f"{end}_pct"]) for end in ("lowest", "highest"))
        whose = "source" if row["origin"] == "paper" else "own"
        texts = (row["text"], whose, stated, " to ".join(ends), f"**{row['class']}**", row["where"])
        rows.append((str(row["claim"]), [Cell(str(text)) for text in texts]))
    return Table("classes", "Claims", columns, rows, corner="No.")


def job_parts(paper: Paper, job: Job, folder: Path) -> list[str]:
    """What the page shows of a job: nothing where its tables are not made."""
    if not all((folder / name).is_file() for name in job.tables):
        return []
    parts = [f"## {job.title or job.name}", *([job.note] if job.note else [])]
    for name in job.tables:
        if name in job.linked:
            pass
        elif "verdicts" in name:
            parts += verdict_parts(read_table(folder / name))
        elif name.endswith("comparison.csv"):
            parts += comparison_parts(paper, job, read_table(folder / name))
        elif name.endswith("-claims.csv"):
            parts += ["### Claims here", *plain(folder / name, CLAIM_COLUMNS)] if rows_in(folder / name) else []
        elif name.endswith(".md"):
            parts.append((folder / name).read_text().strip())
        else:
            parts += [f"### {Path(name).stem}", *plain(folder / name)]
        parts.append(f"[{name}]({name})")
    for stem in job.figures:
        if (folder / "figures" / f"{stem}.png").is_file():
            parts.append(f"![{stem.replace('_', ' ').replace('-', ' ')}](figures/{stem}.png)")
    return parts


CLAIM_COLUMNS = ("id", "text", "paper_pct", "measured_pct", "ci_low", "ci_high", "n", "p_holm", "verdict")


def verdict_parts(table: pd.DataFrame) -> list[str]:
    """Claims down, readings across: effect, interval and verdict; of a claim without an effect the verdict alone."""
    from testbed.report.labels import percent
    from testbed.report.tables import Cell, Column, Table

    readings = list(dict.fromkeys(table["reading"]))
    rows = []
    for claim, part in table.groupby("claim", sort=False):
        by_reading = part.set_index("reading").to_dict("index")
        cells = []
        for reading in readings:
            if (row := by_reading.get(reading)) is None:
                cells.append(Cell("–"))
                continue
            if row["effect_pct"] != row["effect_pct"]:
                cells.append(Cell(row["verdict"]))
                continue
            ends = " to ".join(percent(row[f"ci_{end}"]) for end in ("low", "high"))
            cells.append(Cell(f"{percent(row['effect_pct'])} ({ends}), {row['verdict']}"))
        rows.append((str(claim), cells))
    columns = [Column(reading, numeric=False) for reading in readings]
    runs = table.groupby("reading", sort=False)["runs"].max()
    counts = ", ".join(f"{reading} {count:g}" for reading, count in runs.items())
    note = f"Lower by, %, with the 95 % interval, and the verdict. Paired runs: {counts}."
    if table["effect_pct"].isna().all():
        note = f"Verdicts on places. Searches of each algorithm: {counts}."
    return ["### Verdicts", markdown(Table("verdicts", "", columns, rows, note, "Claim"))]


def comparison_parts(paper: Paper, job: Job, table: pd.DataFrame) -> list[str]:
    """Per reading and window: estimators down, metrics across; then the paper's own tables beside ours."""
    from testbed.report.labels import number, window_label
    from testbed.report.tables import Cell, Column, Table
    from testbed.scoring.quantities import short_label, unit

    parts = []
    table = table.assign(reading=table["reading"].astype(object).fillna(""))
    for (reading, window), part in table.groupby(["reading", "window"], sort=False):
        metrics = list(dict.fromkeys(part["metric"]))
        values = part.pivot(index="estimator", columns="metric", values="mean")
        rows = [
            (str(label), [Cell(number(values.loc[label, metric])) for metric in metrics])
            for label in dict.fromkeys(part["estimator"])
        ]
        columns = [Column(short_label(metric), unit(metric)) for metric in metrics]
        counts = sorted({int(n) for n in part["runs"].dropna()})
        over = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else str(counts[0])
        heading = f"### Errors, {window_label(window)}" + (f": {reading}" if reading else "")
        parts += [heading, markdown(Table("errors", "", columns, rows, f"RMSE, mean over {over} runs."))]
    return parts + (paper_tables(job.setting.load(paper.name), table) if job.setting is not None else [])


def paper_tables(scenario: Scenario, table: pd.DataFrame) -> list[str]:
    """The source's tables, its figures beside ours under each reading; computing time stands in ``timings.md``."""
    from testbed.report.labels import number
    from testbed.report.tables import Cell, Column, Table

    parts: list[str] = []
    readings = list(dict.fromkeys(table["reading"]))
    keys = ["reading", "estimator", "window", "metric"]
    for spec in scenario.tables:
        values = table.set_index(keys)[spec.statistic].to_dict()
        rows = []
        for row in spec.rows:
            if row.metric in ("us_per_sample", "seconds"):
                continue
            for printed, estimator in zip(row.paper, spec.columns, strict=False):
                window = row.window or spec.window
                found = [values.get((reading, estimator, window, row.metric)) for reading in readings]
                if any(value is not None for value in found):
                    known = number(printed, 4) if not isinstance(printed, str) and printed != -1 else "–"
                    cells = [Cell(estimator), Cell(known), *(Cell(number(value)) for value in found)]
                    rows.append((f"{row.name}, {row.unit}" if row.unit else row.name, cells))
        heads = [Column("Row", numeric=False), Column("source"), *(Column(reading or "here") for reading in readings)]
        if rows:
            parts += [f"### {spec.title}", markdown(Table("paper", "", heads, rows, spec.note, " "))]
    return parts


def rows_in(path: Path) -> int:
    """Rows of a table beside its head."""
    return len(read_table(path))


def plain(path: Path, columns: tuple[str, ...] = ()) -> list[str]:
    """A table as it is, its first rows where it is long."""
    from testbed.report.labels import number
    from testbed.report.tables import Cell, Column, Table

    frame = read_table(path)
    frame = frame[[name for name in columns if name in frame]] if columns else frame
    numeric = {name: str(frame[name].dtype) not in ("object", "str", "string") for name in frame}
    rows = []
    for values in frame.head(SHOWN_ROWS).itertuples(index=False):
        texts = [shown(value, number) if n else str(value) for value, n in zip(values, numeric.values(), strict=True)]
        rows.append((texts[0], [Cell(text) for text in texts[1:]]))
    heads = [Column(name, numeric=n) for name, n in list(numeric.items())[1:]]
    note = f"The first {SHOWN_ROWS} of {len(frame)} rows." if len(frame) > SHOWN_ROWS else ""
    return [markdown(Table("plain", "", heads, rows, note, str(next(iter(frame.columns)))))]


def shown(value: Any, number: Any) -> str:
    """Whole numbers as such, others with four figures."""
    if value != value:
        return "–"
    return f"{value:.0f}" if value == round(value) and abs(value) < 1e6 else str(number(value, 4))


def markdown(table: Table) -> str:
    from testbed.report.text import markdown_table

    return markdown_table(table)


def write_timings(paper: Paper, folder: Path) -> None:
    """``timings.md``: time per IMU sample, against real time, and the verdicts on claims about it. Not compared: they are of one machine."""
    files = [name for job in paper.jobs for name in job.timings if (folder / name).is_file()]
    if not files:
        return
    parts = [
        f"# {paper.title}: computing time",
        "Measured where the tables were made, one thread; no two machines agree.",
    ]
    for name in files:
        if "verdicts" in name:
            parts += [f"## {Path(name).stem}", *verdict_parts(read_table(folder / name))]
        else:
            parts += [f"## {Path(name).stem}", *timing_parts(paper, read_table(folder / name))]
    (folder / "timings.md").write_text("\n\n".join(parts) + "\n")


def timing_parts(paper: Paper, table: pd.DataFrame) -> list[str]:
    """Time per sample and how many times faster than real time the slowest run of an estimator's median is."""
    from testbed.report.labels import number
    from testbed.report.tables import Cell, Column, Table
    from testbed.scenario import list_scenarios

    scenario = Setting().load(paper.name) if paper.name in list_scenarios() else None
    rate = getattr(getattr(scenario, "flight", None), "rate_hz", None)
    rows = []
    for label, part in table.groupby("estimator", sort=False):
        median, samples = part["median_us"].median(), part["samples"].iloc[0]
        cells = [Cell(number(median)), Cell(f"{samples:.0f}"), Cell(number(1e-6 * median * samples))]
        rows.append((str(label), [*cells, Cell(number(1e6 / (rate * median)) if rate else "–")]))
    heads = [Column("Median per sample", "µs"), Column("Samples"), Column("One run", "s"), Column("Times real time")]
    return [markdown(Table("timings", "", heads, rows, "Median over the readings of the median over the runs."))]


def write_html(paper: Paper, folder: Path, pages: Path, text: str, commit: str, made: Mapping[str, Any]) -> None:
    """The page and its tables into the untracked folder; the page names its commit and those of its tables."""
    from testbed.report import html

    pages.mkdir(parents=True, exist_ok=True)
    lines = [f"- {name}: `{entry['commit']}`, {entry['minutes']:.1f} minutes" for name, entry in made.items()]
    body = text.split("\n", 1)[1] + f"\n## Commits\n\nThis page: `{commit}`. Its tables:\n\n" + "\n".join(lines) + "\n"
    kind = f"Navigation testbed, commit {commit}"
    (pages / "report.html").write_text(html.document(paper.title, kind, "", body, folder))
    for path in folder.iterdir():
        if path.suffix in (".csv", ".md", ".json"):
            shutil.copy(path, pages / path.name)
