"""The index over several results: one row per scenario with its headline, verdict counts and link, as HTML and Markdown.

Source: the result folders themselves. Links are relative to the index.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote

from testbed.report import html
from testbed.report.headline import headline
from testbed.report.labels import verdict_kind
from testbed.report.results import load_result

KINDS = {"good": "reproduced", "part": "in part", "bad": "not reproduced", "open": "not tested"}


@dataclass(frozen=True)
class Entry:
    """A report in the index; ``variants`` are further reports of the same scenario, which share its row."""

    scenario: str
    variant: str
    folder: str
    title: str
    source: str
    link: str
    sentence: str
    runs: int
    verdicts: dict[str, int]
    variants: tuple[Entry, ...] = ()

    @property
    def counts(self) -> str:
        """The verdicts in words."""
        return ", ".join(f"{self.verdicts[kind]} {word}" for kind, word in KINDS.items() if self.verdicts[kind])


def write_index(dirs: list[Path], out: Path) -> Path:
    """Write the page and its Markdown twin; return the page's path."""
    page = out if out.suffix == ".html" else out / "index.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    reports = [_entry(folder, page.parent) for folder in dirs]
    totals = {kind: sum(report.verdicts[kind] for report in reports) for kind in KINDS}
    entries = _rows(reports)
    values = {"entries": entries, "reports": len(reports), "kinds": KINDS, "totals": totals}
    text = html.template("index.html.j2").render(
        style=html.asset("report.css"), script=html.asset("index.js"), **values
    )
    page.write_text(text, encoding="utf-8")
    page.with_suffix(".md").write_text(_markdown(entries), encoding="utf-8")
    return page


def _rows(reports: list[Entry]) -> list[Entry]:
    """One row per scenario: the report of the scenario as it stands (else the first), its variants behind it."""
    groups: dict[str, list[Entry]] = {}
    for report in reports:
        groups.setdefault(report.scenario, []).append(report)
    rows = []
    for group in groups.values():
        first = next((report for report in group if not report.variant), group[0])
        rows.append(replace(first, variants=tuple(report for report in group if report is not first)))
    return rows


def _entry(folder: Path, start: Path) -> Entry:
    """The entry of a result folder, or of a report that left ``report.json``, as a tuning study does."""
    link = quote(Path(os.path.relpath(folder / "report.html", start)).as_posix())
    if (folder / "report.json").is_file():
        told = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        names, runs, verdicts = (told["scenario"], told["variant"] or ""), told["runs"], told["verdicts"]
        title, source, sentence = told["title"], told["source"], told["sentence"]
    else:
        result = load_result(folder)
        names = str(result.manifest.get("scenario")), result.manifest.get("variant") or ""
        title, source, runs, verdicts = result.title, result.source, result.run_count, result.claims["verdict"]
        sentence = headline(result).sentences[0] + (f" Changed: {result.changed}." if result.changed else "")
    counts = Counter(verdict_kind(verdict) for verdict in verdicts)
    return Entry(*names, folder.name, title, source, link, sentence, runs, {kind: counts[kind] for kind in KINDS})


def _markdown(entries: list[Entry]) -> str:
    lines = [
        "| Scenario | Headline | " + " | ".join(KINDS.values()) + " | runs |",
        "| :--- | :--- |" + " ---: |" * (len(KINDS) + 1),
    ]
    for e in entries:
        counts = " | ".join(str(e.verdicts[kind]) for kind in KINDS)
        also = ", ".join(
            f"[{v.variant or v.folder}]({v.link})" + (f" ({v.counts})" if v.counts else "") for v in e.variants
        )
        sentence = f"{e.sentence} Also: {also}." if also else e.sentence
        lines.append(f"| [{e.title}]({e.link}) | {sentence} | {counts} | {e.runs} |")
    return "# Results\n\n" + "\n".join(lines) + "\n"
