"""The index over several results: one row per scenario with its headline, verdict counts and link, as HTML and Markdown.

Source: the result folders themselves. Links are relative to the index.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from testbed.report import html
from testbed.report.headline import headline
from testbed.report.labels import verdict_kind
from testbed.report.results import Result, load_result

KINDS = {"good": "reproduced", "part": "in part", "bad": "not reproduced", "open": "not tested"}


@dataclass(frozen=True)
class Entry:
    """One row of the index."""

    title: str
    source: str
    link: str
    sentence: str
    runs: int
    verdicts: dict[str, int]


def write_index(dirs: list[Path], out: Path) -> Path:
    """Write the page and its Markdown twin; return the page's path."""
    page = out if out.suffix == ".html" else out / "index.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    entries = [_entry(load_result(folder), page.parent) for folder in dirs]
    totals = {kind: sum(entry.verdicts[kind] for entry in entries) for kind in KINDS}
    values = {"entries": entries, "kinds": KINDS, "totals": totals}
    text = html.template("index.html.j2").render(
        style=html.asset("report.css"), script=html.asset("index.js"), **values
    )
    page.write_text(text, encoding="utf-8")
    page.with_suffix(".md").write_text(_markdown(entries), encoding="utf-8")
    return page


def _entry(result: Result, start: Path) -> Entry:
    counts = Counter(verdict_kind(verdict) for verdict in result.claims["verdict"])
    link = quote(Path(os.path.relpath(result.folder / "report.html", start)).as_posix())
    sentence = headline(result).sentences[0]
    return Entry(result.title, result.source, link, sentence, result.run_count, {kind: counts[kind] for kind in KINDS})


def _markdown(entries: list[Entry]) -> str:
    lines = [
        "| Scenario | Headline | " + " | ".join(KINDS.values()) + " | runs |",
        "| :--- | :--- |" + " ---: |" * (len(KINDS) + 1),
    ]
    for e in entries:
        counts = " | ".join(str(e.verdicts[kind]) for kind in KINDS)
        lines.append(f"| [{e.title}]({e.link}) | {e.sentence} | {counts} | {e.runs} |")
    return "# Results\n\n" + "\n".join(lines) + "\n"
