"""Make the committed reports again: sensors, and every paper scenario in its profile ``report`` (``make reports``).

Results go to ``results/report/``; what a reader looks at (page, text, figures, tables) is copied to ``reports/NAME/``.
Give names to make only those: ``python reports/make.py imm-rstekf-2023``. With ``--resume`` runs that are stored are kept.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT.parent / "results" / "report"
SCENARIOS: dict[str, list[str | None]] = {
    "imm-rstekf-2023": [None, "coarse-aligned"],
    "kfann-2018": [
        None,
        "magnitude-matched",
        "magnitude-matched-2",
        "magnitude-matched-3",
        "as-stated-2",
        "as-stated-3",
        "regressors",
    ],
}
"""Paper scenarios and the variants that are reported (None: as the file stands)."""
KEPT = (
    "report.html",
    "report.md",
    "tables.tex",
    "summary.csv",
    "claims.csv",
    "timings.csv",
    "consistency.csv",
    "manifest.json",
)


def main(names: list[str]) -> None:
    """Make the named reports, or all."""
    from testbed.report import render_index

    resume, names = "--resume" in names, [name for name in names if name != "--resume"]
    if not names or "sensors" in names:
        from testbed.sensors.datasheet_report import write_report

        write_report(ROOT / "sensors")
    for name in SCENARIOS:
        if not names or name in names:
            for variant in SCENARIOS[name]:
                make(name, variant, resume)
            if name in STUDIES:
                STUDIES[name](resume)
    made = sorted(path.parent for path in ROOT.glob("*/manifest.json"))
    if made:
        render_index(made, ROOT)


def make(name: str, variant: str | None, resume: bool = False) -> None:
    """Run one scenario in one variant and copy its report; ``resume`` keeps the runs that are stored."""
    from testbed.commands import progress_line
    from testbed.report import render
    from testbed.runner import run
    from testbed.scenario import load_scenario, overlays_of

    folder = name if variant is None else f"{name}-{variant}"
    profile = "report" if "report" in overlays_of(name)[0] else None
    scenario = load_scenario(name, profile=profile, variant=variant)
    with progress_line(folder) as tell:
        known = resume and (RESULTS / folder / "manifest.json").is_file()
        run(scenario, RESULTS / folder, progress=tell, resume=known)
    findings = ROOT / folder / "findings.md"
    if findings.is_file():
        shutil.copy(findings, RESULTS / folder / "findings.md")
    render(RESULTS / folder, svg=False)
    target = ROOT / folder
    target.mkdir(exist_ok=True)
    for file in KEPT:
        if (RESULTS / folder / file).is_file():
            shutil.copy(RESULTS / folder / file, target / file)
    shutil.rmtree(target / "figures", ignore_errors=True)
    shutil.copytree(RESULTS / folder / "figures", target / "figures")


def kfann_studies(resume: bool) -> None:
    """Map over outage length and gyro bias, and the networks' output beside the error that they should give."""
    import kfann_maps

    kfann_maps.make_maps(RESULTS / "kfann-2018-map", ROOT / "kfann-2018", resume, announce=print)
    for folder in ("kfann-2018", "kfann-2018-magnitude-matched"):
        figure = kfann_maps.draw_network_output(RESULTS / folder)
        figure.savefig(ROOT / folder / "network-output.png", dpi=120, metadata={"Software": None})


STUDIES: dict[str, Callable[[bool], None]] = {"kfann-2018": kfann_studies}
"""What a scenario's report has beside its runs."""


if __name__ == "__main__":
    main(sys.argv[1:])
