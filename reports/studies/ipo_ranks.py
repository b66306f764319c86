"""The claims of IPO 2022 from the rows of its searches: places with intervals over the search seeds, and who is better under which reading.

A reading says which searches stand for an algorithm; one whose searches are not all made is left out. Seeds of two algorithms
are independent, so pairing them by number costs only degrees of freedom.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipo_searches import TEN, THREE
from jobs import Place, read_table, write_csv

if TYPE_CHECKING:
    import pandas as pd

SIX = ("ipo", "pso", "sipo", "ga", "iipo", "mipo")
"""In the order of the paper's final ranking."""
CASES = ("ADIS16405", "ADIS16488")


@dataclass(frozen=True, eq=False)
class Reading:
    """``parts``: which job's searches stand for an algorithm ("": for all that are not named)."""

    name: str
    conditions: Mapping[str, str]
    parts: Mapping[str, str]
    seeds: tuple[int, ...]
    beside: str | None = None
    """A job without whose searches this reading says nothing new, so that it is left out too."""

    def table_of(self, algorithm: str) -> str:
        """The file with its searches."""
        part = self.parts.get(algorithm, f"{self.parts['']}-{group(algorithm)}")
        return f"searches-{part}.csv"

    def rows(self, folder: Path) -> pd.DataFrame | None:
        """The searches of the six, or None where some are not made."""
        import pandas as pd

        if self.beside is not None and not (folder / f"searches-{self.beside}.csv").is_file():
            return None
        found = []
        for algorithm in SIX:
            path = folder / self.table_of(algorithm)
            if not path.is_file():
                return None
            table = read_table(path)
            found.append(table[(table["algorithm"] == algorithm) & table["seed"].isin(self.seeds)])
        return pd.concat(found, ignore_index=True)


def group(algorithm: str) -> str:
    """The end of the name of the job that has an algorithm: the two that ask for single candidates share one."""
    return "sipo-iipo" if algorithm in ("sipo", "iipo") else algorithm


PAPER_BOX, LOG_BOX = "0 to 1", "three decades either way of the data sheet"


def reading(
    name: str, parts: Mapping[str, str], seeds: tuple[int, ...] = TEN, beside: str | None = None, **told: str
) -> Reading:
    """What leaves all open points as in the first reading, but for ``told``."""
    usual = {
        "box": PAPER_BOX,
        "iterations": "100",
        "equation 7": "with x_i",
        "planes": "of better agents",
        "IIPO": "F 1, beta 2",
        "seeds": f"{seeds[0]} to {seeds[-1]}",
    }
    return Reading(name, usual | {key.replace("_", " "): value for key, value in told.items()}, parts, seeds, beside)


READINGS = (
    reading("0 to 1, 100 iterations", {"": "box-100"}),
    reading("0 to 1, 100 iterations, seeds 1 to 3", {"": "box-100"}, seeds=THREE, beside="box-200-ipo"),
    reading("0 to 1, 200 iterations", {"": "box-200"}, seeds=THREE, iterations="200"),
    reading(
        "0 to 1, eq. 7 as printed",
        {"": "box-100", "ipo": "box-100-eq7-ipo", "mipo": "box-100-eq7-mipo"},
        equation_7="as printed",
    ),
    reading(
        "0 to 1, planes of worse agents",
        {"": "box-100", "ipo": "box-100-worse-ipo", "mipo": "box-100-worse-mipo"},
        planes="of worse agents",
    ),
    reading("0 to 1, IIPO as its scan reads", {"": "box-100", "iipo": "box-100-iipo-scan"}, IIPO="F 2, beta 1.75"),
    reading("log, 100 iterations", {"": "log-100"}, box=LOG_BOX),
    reading("log, 100 iterations, seeds 1 to 3", {"": "log-100"}, seeds=THREE, beside="log-200-ipo", box=LOG_BOX),
    reading("log, 200 iterations", {"": "log-200"}, seeds=THREE, box=LOG_BOX, iterations="200"),
)
"""Those of 200 iterations have three seeds, so the same three stand at 100 too: what differs from ten seeds is not the length's doing."""
SHORT = {PAPER_BOX: "0 to 1", LOG_BOX: "log"}
SHEETS = tuple(
    row
    for box, name, recorded in ((PAPER_BOX, "box-100-ipo", "navego-box"), (LOG_BOX, "log-100-ipo", "navego-log"))
    for row in (
        (box, "the errors searched", name, "train", "data-sheet.csv", "train"),
        (box, "unseen errors", name, "test", "data-sheet.csv", "test"),
        (box, "NaveGo simulation", recorded, "train", "navego-data-sheet.csv", "train"),
    )
)
"""Box, errors of the sensors, job of the searches, their column, table of the data sheet's settings, and which runs of it."""
FIRST = {
    "fitness, min": ("1-min", "IPO has the lowest minimum of the fitness of the six"),
    "fitness, variance": ("1-variance", "IPO has the lowest variance of the fitness of the six"),
    "all": ("1-final", "IPO is first in the final ranking: sum of ranks over all statistics, time left out"),
}
"""Parts of the places of which the paper says that IPO is first; of the mean there is a claim against each rival."""
PRINTED_RANKS = 128
"""Ranks in each printed sum; time is among them. Ours have fewer, so it is the means of the ranks that stand side by side."""
PLACES, RANKING, BESIDE = "places.csv", "ranking.csv", "table-2.csv"
FITNESS, FIRSTS, SHEET = "verdicts-fitness.csv", "verdicts-places.csv", "verdicts-data-sheet.csv"
TABLES = (BESIDE, RANKING, PLACES, FITNESS, FIRSTS, SHEET)
COLUMNS = "claim text origin reading stated_pct effect_pct runs ci_low ci_high p_value p_holm verdict".split()
"""Of a table of verdicts, before the class."""


def made(folder: Path) -> dict[str, str]:
    """Which tables of searches are there, each with its checksum: what the ranks hang on."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in sorted(folder.glob("searches-*.csv"))
    }


def make(place: Place) -> None:
    """`TABLES` of every reading whose searches are made. Exits where there is none."""
    import pandas as pd

    found = {reading: rows for reading in READINGS if (rows := reading.rows(place.target)) is not None}
    if not found:
        sys.exit("ipo-2022/ranks: no reading has the searches of all six algorithms yet; make those of box-100 first")
    tables = [places(rows).assign(reading=reading.name) for reading, rows in found.items()]
    table = pd.concat(tables, ignore_index=True)
    write_csv(place.target / PLACES, table[["reading", *table.columns.drop("reading")]])
    write_csv(place.target / RANKING, side_by_side(table))
    write_csv(place.target / BESIDE, beside_printed(found, table))
    write_csv(place.target / FITNESS, verdicts(found))
    write_csv(place.target / FIRSTS, first_verdicts(table, list(found)))
    write_csv(place.target / SHEET, sheet_verdicts(place.target))


def places(rows: pd.DataFrame) -> pd.DataFrame:
    """Table 4 with its sub-ranks: fitness by statistic, fitness, each IMU, all; without time, which is of one machine."""
    from testbed.tuning.ranks import STATISTICS, rank_table

    lines = rows.rename(columns={"best": "fitness"})
    parts = {f"fitness, {s}": [("fitness", s)] for s in STATISTICS}
    parts["fitness"] = [("fitness", s) for s in STATISTICS]
    for case in CASES:
        parts[case] = [(name, s) for name in lines.columns if name.startswith(f"{case}:") for s in STATISTICS]
    parts["all"] = parts["fitness"] + parts[CASES[0]] + parts[CASES[1]]
    table = rank_table(lines, parts).assign(searches=len(lines) // len(SIX))
    mean, least = (lines.groupby("algorithm")["fitness"].agg(how) for how in ("mean", "min"))
    return table.assign(fitness_mean=table["algorithm"].map(mean), fitness_min=table["algorithm"].map(least))


def side_by_side(table: pd.DataFrame) -> pd.DataFrame:
    """A column per algorithm: its place, and the interval of the place in brackets."""
    import pandas as pd

    rows = []
    for (reading, part), own in table.groupby(["reading", "part"], sort=False):
        row = {"reading": reading, "part": part, "searches": own["searches"].iloc[0]}
        for entry in own.to_dict("records"):
            row[entry["algorithm"]] = f"{entry['place']:g} ({entry['place_low']:g} to {entry['place_high']:g})"
        rows.append(row)
    return pd.DataFrame(rows)


def beside_printed(found: Mapping[Reading, pd.DataFrame], ranked: pd.DataFrame) -> pd.DataFrame:
    """Table 2: each printed row of fitness and RMSE (degrees; time left out), and below it the same of our searches by reading.

    Last the mean rank of Table 4 (the printed sum by `PRINTED_RANKS`); ``ranked`` are the `places` of all readings.
    """
    import pandas as pd

    from testbed.tuning.tables import statistic_rows

    ours = {
        reading.name: statistic_rows(rows.rename(columns={"best": "fitness"}), SIX) for reading, rows in found.items()
    }
    out = []
    for row in printed_rows():
        key = {"quantity": row.quantity, "statistic": row.statistic}
        told = {
            name: table.loc[(row.quantity, row.statistic)]
            for name, table in ours.items()
            if tuple(key.values()) in table.index
        }
        out += [key | {"source": "paper"} | {a: row.values[a] for a in SIX}] if told else []
        out += [key | {"source": name} | values.to_dict() for name, values in told.items()]
    sums = next(row.values for row in printed_rows() if row.quantity == "rank_sum")
    key = {"quantity": "rank", "statistic": "mean"}
    out.append(key | {"source": "paper"} | {a: sums[a] / PRINTED_RANKS for a in SIX})
    own = ranked[ranked["part"] == "all"].assign(mean=lambda table: table["rank_sum"] / table["rows"])
    for reading, rows in own.groupby("reading", sort=False):
        out.append(key | {"source": reading} | rows.set_index("algorithm")["mean"].to_dict())
    return pd.DataFrame(out, columns=["quantity", "statistic", "source", *SIX])


def first_verdicts(table: pd.DataFrame, readings: Sequence[Reading]) -> pd.DataFrame:
    """Claim 1 on places: reproduced where the interval of IPO's place is the first alone, reversed where it leaves the first out."""
    import pandas as pd

    from testbed.scoring.verdicts import REPRODUCED, REVERSED, UNDECIDED

    rows = []
    own = table[table["algorithm"] == "ipo"].set_index(["part", "reading"])
    for part, (number, text) in FIRST.items():
        for reading in readings:
            found = own.loc[(part, reading.name)]
            verdict = REPRODUCED if found["place_high"] <= 1.0 else REVERSED if found["place_low"] > 1.0 else UNDECIDED
            row = {"claim": number, "text": text, "origin": "paper", "reading": reading.name}
            rows.append(row | {"runs": found["searches"], "verdict": verdict})
    return classed(
        pd.DataFrame(rows, columns=COLUMNS), {reading.name: dict(reading.conditions) for reading in readings}
    )


def sheet_verdicts(folder: Path) -> pd.DataFrame:
    """Claim 2, what IPO finds against the data sheet's own settings: on the draw of errors that it searched, on others, on NaveGo's.

    Replicates are searches; how far the unseen draws scatter stands in each search's own row.
    """
    import numpy as np

    claim = (
        "2-data-sheet",
        "settings that IPO finds have a lower sum of RMSE than those of the data sheet (mean over searches)",
    )
    measured = []
    for box, errors, part, column, sheet, which in SHEETS:
        paths = folder / f"searches-{part}.csv", folder / sheet
        if not all(path.is_file() for path in paths):
            continue
        table, own = (read_table(path) for path in paths)
        values = table.loc[table["algorithm"] == "ipo", column].to_numpy()
        base = own.loc[(own["row"] == "data-sheet") & (own["set"] == which), "sum"].sum()
        conditions = {"box": box, "errors": errors}
        measured.append((f"{SHORT[box]}, {errors}", conditions, values, np.full(len(values), base)))
    return judged({claim: None}, measured)


def verdicts(found: Mapping[Reading, pd.DataFrame]) -> pd.DataFrame:
    """Claim 1, IPO against each of the five: the mean of its fitness is lower by what the paper's Table 2 prints."""
    printed = printed_means()
    parts = []
    for rival in SIX[1:]:
        claim = f"1-{rival}", f"IPO finds a lower sum of RMSE than {rival.upper()} (mean over searches)"
        measured = []
        for reading, table in found.items():
            own, other = (table.loc[table["algorithm"] == a, "best"].to_numpy() for a in ("ipo", rival))
            measured.append((reading.name, dict(reading.conditions), own, other))
        parts.append((claim, 100.0 * (1.0 - printed["ipo"] / printed[rival]), measured))
    stated = {claim: percent for claim, percent, _ in parts}
    return judged(stated, *(measured for *_, measured in parts))


Measured = Sequence[tuple[str, dict[str, str], Any, Any]]
"""Reading, its conditions, values of what is claimed to be lower, and of the other."""


def judged(stated: Mapping[tuple[str, str], float | None], *measured: Measured) -> pd.DataFrame:
    """A row per claim ((id, text) to the stated per cent) and reading; Holm over the claims of a reading."""
    import pandas as pd

    from testbed.scoring.claims import ClaimConfig
    from testbed.scoring.verdicts import check_claims

    rows: list[dict[str, Any]] = []
    for k, (reading, *_) in enumerate(measured[0]):
        claims, values = [], {}
        for (number, text), rows_of_claim in zip(stated, measured, strict=True):
            own, than = f"{number} own", f"{number} than"
            values |= {own: rows_of_claim[k][2], than: rows_of_claim[k][3]}
            more = {"id": number, "text": text, "paper_improvement_pct": stated[number, text]}
            claims.append(ClaimConfig(better=own, than=than, metric="fitness", **more))  # type: ignore[arg-type]
        for row in check_claims(claims, lambda name, *_, values=values: values[name], seed=0):  # type: ignore[misc]
            told = {"claim": row["id"], "text": row["text"], "origin": "paper", "reading": reading}
            told |= {"stated_pct": row["paper_pct"], "effect_pct": row["measured_pct"], "runs": row["n"]}
            rows.append(told | {key: row[key] for key in ("ci_low", "ci_high", "p_value", "p_holm", "verdict")})
    return classed(pd.DataFrame(rows, columns=COLUMNS), {name: told for name, told, *_ in measured[0]})


def classed(verdicts: pd.DataFrame, conditions: Mapping[str, dict[str, str]]) -> pd.DataFrame:
    """Verdicts with the class of each claim over its readings. ``conditions``: by reading."""
    from testbed.scoring.claims import ReadingConfig
    from testbed.scoring.readings import standing

    configs = [ReadingConfig(name=name, leaves_open="-", conditions=told) for name, told in conditions.items()]
    classes = {
        claim: standing(configs, dict(zip(part["reading"], part["verdict"], strict=True))).word
        for claim, part in verdicts.groupby("claim")
    }
    return verdicts.assign(**{"class": verdicts["claim"].map(classes)})


def printed_rows() -> list[Any]:
    """What the scenario quotes of the paper's tables."""
    from testbed.scenario import load_scenario
    from testbed.tuning.config import tune_config

    return tune_config(load_scenario("ipo-2022")).paper


def printed_means() -> dict[str, float]:
    """The paper's mean fitness of each algorithm."""
    return next(row.values for row in printed_rows() if (row.quantity, row.statistic) == ("fitness", "mean"))


def make_printed(place: Place) -> None:
    """``printed.csv``: of each algorithm the printed mean fitness beside the sum of the printed means of its six attitude RMSE.

    The fitness is a sum in which these six are terms, so its mean cannot be less than the sum of theirs: ``verdicts-printed.csv``.
    There too what the paper says of hours, which another machine and another language can neither confirm nor refute.
    """
    import pandas as pd

    from testbed.scoring.verdicts import NOT_TESTED

    fitness = printed_means()
    angles = [row.values for row in printed_rows() if row.quantity.endswith("_deg") and row.statistic == "mean"]
    rows = []
    for algorithm in SIX:
        total = sum(values[algorithm] for values in angles)
        entry = {"algorithm": algorithm, "fitness_mean": fitness[algorithm], "attitude_rmse_sum_deg": total}
        rows.append(entry | {"terms": len(angles), "times": total / fitness[algorithm]})
    table = pd.DataFrame(rows)
    write_csv(place.target / "printed.csv", table)
    lower = 100.0 * (1.0 - table["fitness_mean"] / table["attitude_rmse_sum_deg"])
    own = table.iloc[0]
    hours = [h for row in printed_rows() if row.quantity == "hours" for h in row.values.values()]
    common = {"origin": "paper", "reading": "as printed", "stated_pct": float("nan"), "runs": 1}
    claims = [
        {
            "claim": "1-printed",
            "text": f"IPO's fitness, a sum that has six attitude RMSE among its terms, is {own['fitness_mean']:g} in the mean; the same"
            f" Table 2 has {own['attitude_rmse_sum_deg']:.1f} for the sum of these terms' means",
            "effect_pct": lower[0],
            "ci_low": lower[0],
            "ci_high": lower[0],
            "class": "source inconsistent",
        },
        {
            "claim": "3-hours",
            "text": f"one search takes {min(hours):g} to {max(hours):g} hours (Table 2: MATLAB, four computers); another machine and"
            " another language cannot tell",
            "class": NOT_TESTED,
        },
    ]
    rows = [common | claim | {"verdict": NOT_TESTED} for claim in claims]
    write_csv(place.target / "verdicts-printed.csv", pd.DataFrame(rows, columns=[*COLUMNS, "class"]))
