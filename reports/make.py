"""Make the committed reports again: sensors, and every paper scenario in its profile ``report`` (``make reports``).

Results go to ``results/report/``; what a reader looks at (page, text, figures, tables) is copied to ``reports/NAME/``.
Give names to make only those: ``python reports/make.py imm-rstekf-2023``. With ``--resume`` runs and studies that are stored
are kept. Everything takes an hour on two cores; ``--long`` adds what takes hours more (trainings of the AHRS networks, the flight of
nine hours). What is not made again stays as it was committed.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pictures

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
    "narx-ukf-2021": [None, "bias-blind"],
    "ahrs-lstm-2022": [None],
}
"""Paper scenarios and the variants that are reported (None: as the file stands)."""
RUNS = {"narx-ukf-2021-bias-blind": 20}
"""Of a report that needs fewer runs than the scenario's profile has: half a minute each, and effects far above the noise."""
KEPT = (
    "report.html",
    "report.md",
    "report.json",
    "tables.tex",
    "summary.csv",
    "claims.csv",
    "timings.csv",
    "consistency.csv",
    "manifest.json",
    "scenario.toml",
)


def main(names: list[str]) -> None:
    """Make the named reports, or all."""
    from testbed.report import render_index

    resume, long = "--resume" in names, "--long" in names
    names = [name for name in names if name not in ("--resume", "--long")]
    if unknown := [name for name in names if name not in (*SCENARIOS, "sensors", "ipo-2022")]:
        sys.exit(f"{unknown[0]}: no such report; there are sensors, {', '.join(SCENARIOS)}, ipo-2022")
    if not names or "sensors" in names:
        from testbed.sensors.datasheet_report import write_report

        write_report(ROOT / "sensors")
    for name in SCENARIOS:
        if not names or name in names:
            for variant in SCENARIOS[name]:
                make(name, variant, resume)
            if name in STUDIES:
                STUDIES[name](resume, long)
    if not names or "ipo-2022" in names:
        ipo_studies()
    print(f"figures: {pictures.shrink(ROOT) / 1e6:.1f} MB")
    made = sorted(path.parent for path in ROOT.glob("*/report.json"))
    if made:
        render_index(made, ROOT, replace_others=True)


def make(name: str, variant: str | None, resume: bool = False) -> None:
    """Run one scenario in one variant and copy its report; ``resume`` keeps the runs that are stored."""
    from testbed.cli.console import progress_line
    from testbed.montecarlo.runner import run
    from testbed.report import render
    from testbed.scenario import load_scenario, overlays_of

    folder = name if variant is None else f"{name}-{variant}"
    profile = "report" if "report" in overlays_of(name)[0] else None
    scenario = load_scenario(name, profile=profile, variant=variant)
    with progress_line(folder) as tell:
        known = resume and (RESULTS / folder / "manifest.json").is_file()
        run(scenario, RESULTS / folder, runs=RUNS.get(folder), progress=tell, resume=known)
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


def kfann_studies(resume: bool, _long: bool) -> None:
    """Map over outage length and gyro bias, what else to feed the filter with, and the networks' output beside the error."""
    import kfann_fed
    import kfann_maps

    kfann_maps.make_maps(RESULTS / "kfann-2018-map", ROOT / "kfann-2018", resume, announce=print)
    kfann_fed.make_table(RESULTS / "kfann-2018-fed", ROOT / "kfann-2018", resume, announce=print)
    for folder in ("kfann-2018", "kfann-2018-magnitude-matched"):
        figure = kfann_maps.draw_network_output(RESULTS / folder)
        figure.savefig(ROOT / folder / "network-output.png", dpi=120, metadata={"Software": None})


def narx_studies(resume: bool, _long: bool) -> None:
    """What grows in an outage, what the networks can learn of it, and whether a bad start tells UKF from EKF."""
    import narx_lessons
    import outage_growth

    own, blind = ROOT / "narx-ukf-2021", ROOT / "narx-ukf-2021-bias-blind"
    wide = {"initial.yaw_deg": 40.0, "initial.roll_pitch_deg": 5.0}
    studies: dict[Path, Callable[[], Path]] = {
        own / "outage-growth.md": lambda: outage_growth.write_growth(own),
        own / "outage-growth-no-scale-factor.md": lambda: outage_growth.write_growth(
            own, "no-scale-factor", name="no-scale-factor"
        ),
        own / "outage-growth-wide-start.md": lambda: outage_growth.write_growth(own, None, wide, "wide-start"),
        blind / "outage-growth.md": lambda: outage_growth.write_growth(blind, "bias-blind"),
        own / "lessons.md": lambda: narx_lessons.write_lessons(own),
        blind / "lessons.md": lambda: narx_lessons.write_lessons(blind, "bias-blind"),
    }
    for path, write in studies.items():
        if not (resume and path.is_file()):
            print(path.relative_to(ROOT))
            write()


def ahrs_studies(resume: bool, long: bool) -> None:
    """Allan table, cruise and loiter, structures, other units and aircraft, nine hours, learning curve."""
    import ahrs_studies as studies

    studies.make_studies(resume, long)


def ipo_studies() -> None:
    """The page of the tuning studies from what ``reports/ipo-2022/studies`` keeps, or from newer searches in ``results``.

    The searches themselves take hours: ``testbed tune ipo-2022 --algorithms ga,pso,ipo,mipo,sipo,iipo --iterations 100,200
    --out results/report/ipo-2022-tuning``, and the same with each ``--variant`` of the scenario.
    """
    from testbed.tuning.publish import publish

    publish("ipo-2022", RESULTS, ROOT / "ipo-2022")


STUDIES: dict[str, Callable[[bool, bool], None]] = {
    "ahrs-lstm-2022": ahrs_studies,
    "kfann-2018": kfann_studies,
    "narx-ukf-2021": narx_studies,
}
"""What a scenario's report has beside its runs."""


if __name__ == "__main__":
    main(sys.argv[1:])
