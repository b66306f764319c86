"""The index over several results: one row per scenario with its headline, verdict counts and link, as HTML and Markdown.

Source: the result folders themselves. Links are relative to the index.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from testbed.base.checksums import read_json
from testbed.base.errors import InputError
from testbed.montecarlo.folders import MANIFEST, Folder, check_own
from testbed.report import html
from testbed.report.headline import headline
from testbed.report.labels import verdict_kind
from testbed.report.results import Result, load_result

KINDS = {"good": "reproduced", "part": "in part", "bad": "not reproduced", "open": "not tested"}
LEGEND = {
    "good": "the 95 % interval lies above zero and reaches the stated figure; of an equality, inside of its margin",
    "part": "above zero, but smaller than stated, or carried by a few runs",
    "bad": "the interval contains zero, or the effect is the opposite one",
    "open": "too few runs that differ, or they do not decide",
}
"""What a verdict of each kind says."""


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
    own: dict[str, int]
    """Verdicts on our own claims, which are counted apart."""
    variants: tuple[Entry, ...] = ()

    @property
    def counts(self) -> str:
        """The verdicts in words."""
        return "; ".join(
            filter(None, (_in_words(self.verdicts), f"own claims: {own}" if (own := _in_words(self.own)) else ""))
        )

    @property
    def own_counts(self) -> str:
        """The verdicts on our own claims in words."""
        return _in_words(self.own)


def _in_words(counts: dict[str, int]) -> str:
    return ", ".join(f"{counts[kind]} {word}" for kind, word in KINDS.items() if counts[kind])


def write_index(dirs: list[Path], out: Path, replace_others: bool = False) -> Path:
    """Write the page and its Markdown twin; return the page's path. ``replace_others``: also what the bench did not write."""
    page = out if out.suffix == ".html" else out / "index.html"
    check_own(page.parent, KIND, among=True)
    reports = [_entry(folder, page.parent) for folder in dirs]
    totals = {kind: sum(report.verdicts[kind] for report in reports) for kind in KINDS}
    entries = _rows(reports)
    values = {"entries": entries, "reports": len(reports), "kinds": KINDS, "legend": LEGEND, "totals": totals}
    text = html.template("index.html.j2").render(
        style=html.asset("report.css"), script=html.asset("index.js"), **values
    )
    with Folder.open(page.parent, KIND, among=True) as folder:
        if replace_others:
            folder.files.update(dict.fromkeys((page.name, page.with_suffix(".md").name)))
        folder.write_all({page.name: text.encode(), page.with_suffix(".md").name: _markdown(entries).encode()})
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


KIND = "testbed index"
ENTRY = "report.json"
"""Of a folder with a report: what the index shows of it, for a page that travels without its runs."""


def entry_of(result: Result) -> dict[str, Any]:
    """The content of `ENTRY`."""
    own = result.claims["origin"] == "own"
    return {
        "scenario": result.manifest.get("scenario"),
        "variant": result.manifest.get("variant"),
        "title": result.title,
        "source": result.source,
        "sentence": headline(result).sentences[0] + (f" Changed: {result.changed}." if result.changed else ""),
        "runs": result.run_count,
        "verdicts": [str(verdict) for verdict in result.claims.loc[~own, "verdict"]],
        "own_verdicts": [str(verdict) for verdict in result.claims.loc[own, "verdict"]],
    }


def _entry(folder: Path, start: Path) -> Entry:
    """The entry of a folder with a report. Raises InputError where there is neither a report nor a result."""
    if (folder / ENTRY).is_file() and not (folder / "metrics.parquet").is_file():
        if (folder / MANIFEST).is_file():
            Folder(folder, read_json(folder / MANIFEST)).check(ENTRY)
        told = read_json(folder / ENTRY)
        needed = {"title": str, "source": str, "sentence": str, "runs": int, "verdicts": list}
        for key, kind in needed.items():
            if not isinstance(told.get(key), kind):
                raise InputError(f"{folder / ENTRY}: damaged ('{key}' is not what a report leaves there)")
    else:
        told = entry_of(load_result(folder))
    link = quote(Path(os.path.relpath(folder / "report.html", start)).as_posix())
    counts, own = (Counter(map(verdict_kind, told.get(key, []))) for key in ("verdicts", "own_verdicts"))
    return Entry(
        scenario=str(told["scenario"]),
        variant=told["variant"] or "",
        folder=folder.name,
        title=told["title"],
        source=told["source"],
        link=link,
        sentence=told["sentence"],
        runs=told["runs"],
        verdicts={kind: counts[kind] for kind in KINDS},
        own={kind: own[kind] for kind in KINDS},
    )


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
        sentence = f"{e.sentence} Own claims: {e.own_counts}." if e.own_counts else e.sentence
        sentence += f" Also: {also}." if also else ""
        lines.append(f"| [{e.title}]({e.link}) | {sentence} | {counts} | {e.runs} |")
    return "# Results\n\n" + "\n".join(lines) + "\n"
