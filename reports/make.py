"""Make the reports again (``make reports``): what git keeps in ``reports/``, pages, summaries and LaTeX in ``build/reports/``.

Each paper is a list of jobs (``studies/paper_*.py``), each job leaves tables, and pages are made from the tables. ``--resume`` keeps what is made:
tables in git whose inputs have not changed, and runs in ``results/report/`` of a job that was broken off. ``--long`` adds the jobs that
take long; without it their tables stay as committed. Name papers (``imm-rstekf-2023``) or jobs (``imm-rstekf-2023/readings``) to make only those.
``--trial`` makes everything at the smallest size into ``build/trial``; ``--list`` shows the jobs. A report is made from a clean commit only.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
for place in (ROOT / "studies", ROOT):
    sys.path.insert(0, str(place))

import testbed  # noqa: E402, F401, I001 (before numpy: it chooses the kind of linear algebra)
import index  # noqa: E402
import pages  # noqa: E402
import pictures  # noqa: E402
from jobs import Job, Kept, Paper, Place, readings, study  # noqa: E402, F401

TOP = ROOT.parent
MADE = "made.json"
WRITTEN_BY_HAND = "findings.md"


def main() -> None:
    """Make the named reports or jobs, or all."""
    parser = argparse.ArgumentParser(description="Make the reports again.")
    parser.add_argument("names", nargs="*", help="papers, or PAPER/JOB")
    for flag in ("resume", "long", "trial", "list"):
        parser.add_argument(f"--{flag}", action="store_true")
    options = parser.parse_args()
    papers = all_papers()
    known = [name for paper in papers for name in (paper.name, *(f"{paper.name}/{job.name}" for job in paper.jobs))]
    if unknown := [name for name in options.names if name not in known]:
        sys.exit(f"{unknown[0]}: no such report or job; there are {', '.join(known)}")
    if options.list:
        print("\n".join(listing(papers)))
        return
    target = TOP / "build" / "trial" if options.trial else ROOT
    built = TOP / "build" / ("trial-pages" if options.trial else "reports")
    commit = "trial" if options.trial else clean_commit(papers)
    for paper in papers:
        wanted = [job for job in paper.jobs if is_wanted(paper, job, options)]
        if options.names and not wanted and paper.name not in options.names:
            continue
        for job in wanted:
            make(paper, job, target, commit, options)
        write_pages(paper, target, built, commit)
    index.write(papers, target, built, commit)
    print(f"figures: {pictures.shrink(target) / 1e6:.1f} MB")
    if not options.trial and (changed := changes(papers)):
        print("differs from what is committed:\n  " + "\n  ".join(changed))


def all_papers() -> list[Paper]:
    """Every ``studies/paper_*.py``, and the catalogue's sensors."""
    found = sorted((ROOT / "studies").glob("paper_*.py"))
    return [SENSORS, *(importlib.import_module(path.stem).PAPER for path in found)]


def sensors(place: Place) -> None:
    """Six hours at rest of each unit of the catalogue, a tenth of it in a trial."""
    from testbed.sensors.datasheet_report import DURATION_S, write_report

    write_report(place.target, DURATION_S / 10.0 if place.trial else DURATION_S)


def catalogue(_paper: str) -> list[Any]:
    """What the table of `sensors` follows from: the length, the seed of the first, and every entry."""
    from testbed.sensors import catalog, datasheet_report, list_sensors

    entries = [catalog.entry("imu", model) for model in list_sensors()["imu"]]
    return [datasheet_report.DURATION_S, datasheet_report.FIRST_SEED, entries]


SENSORS = Paper(
    "sensors",
    "IMUs of the catalogue at rest",
    (Job("allan", 2.0, sensors, ("allan.csv", "README.md"), inputs=catalogue),),
)


def is_wanted(paper: Paper, job: Job, options: argparse.Namespace) -> bool:
    """By its name, by its paper's name, or in any case; long jobs by name or where they are asked for."""
    if f"{paper.name}/{job.name}" in options.names:
        return True
    named = not options.names or paper.name in options.names
    return named and (options.long or options.trial or not job.long)


def make(paper: Paper, job: Job, target: Path, commit: str, options: argparse.Namespace) -> None:
    """Run a job and note what it left, unless that is there and its inputs are the same."""
    folder = target / paper.name
    if options.resume and is_made(paper, job, folder):
        print(f"{paper.name}/{job.name}: kept")
        return
    print(f"{paper.name}/{job.name}: at most {job.minutes:g} minutes", flush=True)
    work = TOP / ("build/trial-runs" if options.trial else "results/report") / paper.name / job.name
    made_pages = TOP / "build" / ("trial-pages" if options.trial else "reports") / paper.name / job.name
    for path in (work, folder):
        path.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    try:
        job.make(Place(paper.name, work, folder, made_pages, options.resume, options.trial))
    except Kept as missing:
        print(f"{paper.name}/{job.name}: stays as it is: {missing}")
        return
    if missing := [name for name in job.tables if not (folder / name).is_file()]:
        sys.exit(f"{paper.name}/{job.name}: left no {', '.join(missing)}")
    entry = {"commit": commit, "inputs": job.digest(paper.name), "minutes": (time.monotonic() - started) / 60.0}
    entry["files"] = {name: checksum(folder / name) for name in job.tables}
    note = made(folder) | {job.name: entry}
    (folder / MADE).write_text(json.dumps({key: note[key] for key in sorted(note)}, indent=1) + "\n")


def is_made(paper: Paper, job: Job, folder: Path) -> bool:
    """Whether the tables are there as the job left them, and its inputs are what they were."""
    entry = made(folder).get(job.name)
    if entry is None or entry["inputs"] != job.digest(paper.name):
        return False
    return all((folder / name).is_file() and checksum(folder / name) == known for name, known in entry["files"].items())


def made(folder: Path) -> dict[str, Any]:
    """What is noted of a paper's jobs."""
    path = folder / MADE
    return json.loads(path.read_text()) if path.is_file() else {}


def checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def write_pages(paper: Paper, target: Path, built: Path, commit: str) -> None:
    """Claims, page and HTML of a paper from its tables."""
    folder = target / paper.name
    if paper is SENSORS or not folder.is_dir():
        return
    known = {job.name for job in paper.jobs}
    notes = {name: entry for name, entry in made(folder).items() if name in known}
    pages.write_claims(paper, folder)
    pages.write_timings(paper, folder)
    text = pages.write_report(paper, folder)
    pages.write_html(paper, folder, built / paper.name, text, commit, notes)


def listing(papers: list[Paper]) -> list[str]:
    """Each job with its budget and whether it is made."""
    lines = []
    for paper in papers:
        for job in paper.jobs:
            state = "made" if is_made(paper, job, ROOT / paper.name) else "to do"
            lines.append(f"{paper.name}/{job.name}: {job.minutes:g} minutes{', long' if job.long else ''}, {state}")
    return lines


def clean_commit(papers: list[Paper]) -> str:
    """The commit that stands in the tree. Exits where anything else than what this script writes is not committed."""
    if dirty := [path for path in status() if not is_output(path, papers)]:
        sys.exit(
            f"not committed: {', '.join(dirty[:5])}{' ...' if len(dirty) > 5 else ''}; reports are made from a clean commit"
        )
    return git("rev-parse", "--short=12", "HEAD").strip()


def changes(papers: list[Paper]) -> list[str]:
    """Tables and pages that are not as committed; what is of one machine is not compared."""
    found = [path for path in status() if is_output(path, papers) and path.endswith((".csv", ".md"))]
    return [path for path in found if "timings" not in path]


def is_output(path: str, papers: list[Paper]) -> bool:
    """Whether this script writes the file (relative to the repository)."""
    parts = Path(path).parts
    if parts[:1] != (ROOT.name,):
        return False
    return parts[1:] == (index.PAGE,) or (
        len(parts) > 2 and parts[1] in {paper.name for paper in papers} and parts[-1] != WRITTEN_BY_HAND
    )


def status() -> list[str]:
    """Files that differ from the commit, and files that git does not know and does not ignore."""
    lines = git("status", "--porcelain", "--untracked-files=all", "--no-renames", "-z").split("\0")
    return [line[3:] for line in lines if line]


def git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=TOP, capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    main()
