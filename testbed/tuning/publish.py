"""The studies of a scenario into its folder of reports: what `report.write_report` reads is kept there, the evaluations are not.

Files only; units as in the tables themselves.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from testbed.tuning.report import write_report
from testbed.tuning.tune import read_manifest

KEPT = ("manifest.json", "scenario.toml", "searches.csv", "history.csv", "timings.csv", "scores.csv", "heldout.csv")


def publish(scenario: str, results: str | Path, out: str | Path) -> Path:
    """Take over the finished studies ``SCENARIO*-tuning`` of ``results`` and render all that ``out`` has; returns the report.

    The study without a variant is the report; the others stand in its table of unseen runs. Without results, what an
    earlier call has kept is rendered again.
    """
    kept = Path(out) / "studies"
    for folder in sorted(Path(results).glob(f"{scenario}*-tuning")):
        manifest = read_manifest(folder)
        if manifest is not None and manifest["finished"]:
            _keep(folder, kept / folder.name.removesuffix("-tuning"))
    others = [folder for folder in sorted(kept.iterdir()) if folder.name != scenario]
    return write_report(kept / scenario, out, others=others)


def _keep(folder: Path, target: Path) -> None:
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for name in KEPT:
        shutil.copy(folder / name, target / name)
    shutil.copytree(folder / "best", target / "best")
