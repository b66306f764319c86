"""IPO 2022: what its page is made of. Searches are jobs of their own, all of them long, in the order of their worth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ipo_ranks
import ipo_rounding
from ipo_searches import THREE, Part
from jobs import Job, Paper, Place, Setting, study

ALONE = ("ipo", "mipo", "pso", "ga")
"""Algorithms whose candidates fill the lanes by themselves: a job each."""
TOGETHER = ("sipo", "iipo")
"""They ask for one candidate at a time, so all their seeds go side by side in one job."""
BOX, LOG = "as-stated", None
HERE = Path(__file__).resolve().parents[1] / "ipo-2022"
EQ7 = {name: {"keeps_place": False} for name in ("ipo", "mipo")}
WORSE = {name: {"planes": "worse"} for name in ("ipo", "mipo")}
MINUTES, MINUTES_TOGETHER = 45.0, 100.0
"""Of 50,000 and of 100,000 evaluations (of two recordings) at 0.06 s of one core each, on two."""


def searches(name: str, variant: str | None, **settings: Any) -> list[Job]:
    """The six in one box: a job for each that goes by itself, and one for the two that share passes."""
    minutes = 1.0 if "seeds" not in settings else 0.6
    alone = [Part(f"{name}-{a}", (a,), variant, **settings).job(MINUTES * minutes) for a in ALONE]
    together = Part(f"{name}-{'-'.join(TOGETHER)}", TOGETHER, variant, **settings)
    return [*alone, together.job(MINUTES_TOGETHER * minutes)]


def functions(place: Place) -> None:
    """``functions.csv``: every algorithm on four functions whose minimum is known."""
    from testbed.tuning.report import write_functions

    write_functions(place.target, **({"seeds": 2, "iterations": 4} if place.trial else {}))


PAPER = Paper(
    name="ipo-2022",
    title="IPO 2022: metaheuristic tuning of Q and R",
    source="Tuning of an INS/GNSS filter by inclined planes optimisation, 2022; example of the NaveGo toolbox",
    jobs=(
        study(
            *("data-sheet", ipo_rounding.make_baseline, 3.0, ("data-sheet.csv", "diagonals.csv")),
            scenarios=(Setting(), Setting("ADIS16488")),
            title="The sensors' own settings",
            note="RMSE in m, m/s and degrees, mean over the runs: run 0 is that of the searches (train), 1 to 20 are the"
            " same path with other errors (test). Then the 18 entries that are searched, as the sheet has them: variances of R, densities of Q.",
        ),
        study(
            *("printed", ipo_ranks.make_printed, 1.0, ("printed.csv", "verdicts-printed.csv")),
            title="The paper's Table 2 against itself",
            note="The fitness is a sum of RMSE in which the six of the attitude are terms; a mean of sums is the sum of the means.",
        ),
        *searches("box-100", BOX),
        study(
            *("rounding", ipo_rounding.make_rounding, 15.0, ("rounding.csv", "rounding-search.csv")),
            scenarios=(Setting(BOX), Setting()),
            inputs=[ipo_rounding.CANDIDATES, ipo_rounding.REPEATS, ipo_rounding.ITERATIONS],
            title="What the last bit of a candidate does",
            note="Change of the objective where each coordinate changes by so much of itself; and the best of 20 iterations of IPO (seed 1)"
            " repeated with every candidate changed by 1e-15.",
            long=True,
        ),
        *searches("log-100", LOG),
        *(Part(f"box-100-eq7-{a}", (a,), BOX, changes={"settings": EQ7}).job(MINUTES) for a in ("ipo", "mipo")),
        *(Part(f"box-100-worse-{a}", (a,), BOX, changes={"settings": WORSE}).job(MINUTES) for a in ("ipo", "mipo")),
        Part("box-100-iipo-scan", ("iipo",), BOX, changes={"settings": {"iipo": {"factor": 2.0, "beta": 1.75}}}).job(
            MINUTES_TOGETHER
        ),
        *searches("box-200", BOX, iterations=200, seeds=THREE),
        *searches("log-200", LOG, iterations=200, seeds=THREE),
        Part("log-100-fresh-pso", ("pso",), LOG, seeds=THREE, changes={"noise": "fresh"}).job(60.0),
        *(
            Part(f"navego-{box}", (*ALONE, *TOGETHER), variant, seeds=THREE, recorded=True).job(60.0)
            for box, variant in (("log", "navego"), ("box", "navego-as-stated"))
        ),
        study(
            *("navego-data-sheet", ipo_rounding.make_recorded, 2.0, ("navego-data-sheet.csv",)),
            title="The sensors' own settings on the toolbox's recording",
            note=f"Needs the recording: its folder in the environment variable {ipo_rounding.RECORDING}.",
            long=True,
        ),
        *(
            Part(name, algorithms, name, iterations=iterations, seeds=(1,)).job(minutes)
            for name, algorithms, iterations, minutes in (
                ("six-scales", ("ipo", "cma-es"), 100, 15.0),
                ("six-scales-five-draws", ("cma-es",), 30, 15.0),
                ("five-draws", ("cma-es",), 30, 15.0),
                ("all-errors", ("cma-es",), 30, 15.0),
            )
        ),
        study("functions", functions, 30.0, ("functions.csv",), long=True, title="Functions whose minimum is known"),
        Job(
            *("ranks", 2.0, ipo_ranks.make, ipo_ranks.TABLES),
            title="Table 2 beside ours, the places of the six, and the claim that IPO is the best",
            note="Statistics over the searches of an algorithm: the paper's over lengths of 100 to 500 iterations, ours over seeds at one"
            " length. Then rank sums over the statistics of Table 4 (time left out), with 95 % intervals over the search seeds.",
            long=True,
            linked=(ipo_ranks.PLACES,),
            inputs=lambda _paper: ipo_ranks.made(HERE),
        ),
    ),
)
