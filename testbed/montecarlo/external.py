"""Filters in any language: the logs of N runs out as tables, the answers to them in as rows of a Monte Carlo.

A folder of logs (`write_logs`) holds ``manifest.json``, ``scenario.toml`` and a folder for each run, ``000000`` and so on, with the
tables of `testbed.formats.table`, ``log.json`` and ``initial.csv`` (the initial state for programs that read no JSON). The answer of
a filter NAME to run K goes to ``answers/NAME/K.csv`` (or .parquet), K with six digits, as `testbed.formats.solutions` describes.
Answers are of the place where the IMU sits. `External` is the row of such a filter.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import testbed
from testbed.base.checksums import file_digest, sealed_json
from testbed.base.errors import InputError, closest, tell_user
from testbed.data.columns import columns, exact_columns, pva_columns
from testbed.data.records import STATE_NAMES, InitialState, NavSolution, SensorLog
from testbed.data.shapes import gaps_of
from testbed.montecarlo.folders import MANIFEST, read_manifest, tables_that_differ
from testbed.scenario import EXTERNAL, EstimatorConfig, Scenario

if TYPE_CHECKING:
    import pandas as pd

KIND = "testbed logs"
ANSWERS = "answers"
SUFFIXES = (".csv", ".parquet")
MOST_NAMED = 8
"""Runs or files that one message lists."""
NOT_SENSED = ("flown_by", "testbed")
"""What two manifests may differ in that no key of a scenario says: the flight's model and the version."""


def write_logs(
    scenario: Scenario, folder: Path, runs: int, progress: Callable[[int, int], None] | None = None
) -> dict[str, int]:
    """Sense ``runs`` runs of a scenario into an empty folder; number of samples of each sensor, of all runs together."""
    from testbed import pipeline

    counts: dict[str, int] = {}
    varies = pipeline.flight_varies(scenario)
    trajectory = pipeline.fly(scenario)
    for run in range(runs):
        if progress is not None:
            progress(run, runs)
        if varies and run:
            trajectory = pipeline.fly(scenario, run)
        log, _ = pipeline.sense(scenario, trajectory, run=run)
        write_log(log, folder / run_name(run))
        for kind in ("imu", *log.aiding):
            counts[kind] = counts.get(kind, 0) + len(log.imu.t if kind == "imu" else log.aiding[kind].t)
    if progress is not None:
        progress(runs, runs)
    (folder / "scenario.toml").write_text(scenario.to_toml(), encoding="utf-8")
    manifest = {"kind": KIND, "scenario": scenario.name, "runs": runs, "sensed": sensed_by(scenario)}
    (folder / MANIFEST).write_bytes(sealed_json(manifest))
    return counts


def write_log(log: SensorLog, folder: Path) -> None:
    """One run's folder: the tables of the log, ``log.json`` and ``initial.csv``."""
    from testbed.formats import export_log
    from testbed.formats.table import write_frame

    export_log(log, folder, "csv")
    write_frame(initial_table(log.initial), folder / "initial.csv")


def run_name(run: int) -> str:
    """Of a run's folder, and of the file that answers it."""
    return f"{run:06d}"


def initial_table(initial: InitialState) -> pd.DataFrame:
    """The initial state as one row: time, place, velocity, attitude, biases, and the sigma of each error state."""
    import pandas as pd

    lat, lon, q_nb = np.array([initial.lat]), np.array([initial.lon]), initial.q_nb[None]
    table = pva_columns(np.array([initial.t]), lat, lon, np.array([initial.h]), initial.v_n[None], q_nb)
    table |= exact_columns(lat, lon, q_nb)
    table |= columns("accel_bias_{}_mps2", "xyz", initial.accel_bias[None])
    table |= columns("gyro_bias_{}_radps", "xyz", initial.gyro_bias[None])
    return pd.DataFrame(table | columns("std_{}", STATE_NAMES, initial.std[None]))


def sensed_by(scenario: Scenario) -> dict[str, str]:
    """What determines the logs, by section: two scenarios that agree in it have the same logs."""
    return scenario.sensed_digests() | {"testbed": testbed.__version__}


def with_answers(scenario: Scenario, folders: Sequence[Path]) -> Scenario:
    """The scenario with a row for every filter that answered in the folders of logs. Raises InputError where none did."""
    rows = list(scenario.estimators)
    for folder in folders:
        _check_logs(folder, scenario)
        names = sorted(path.name for path in (folder / ANSWERS).glob("*") if path.is_dir())
        if not names:
            raise InputError(
                f"{folder / ANSWERS}: no folder of answers; a filter called NAME answers run 0 in "
                f"{folder / ANSWERS / 'NAME' / run_name(0)}.csv"
            )
        for name in names:
            if name in {row.row for row in rows}:
                raise InputError(
                    f"{folder / ANSWERS / name}: the scenario has a row '{name}' already; rename the folder"
                )
            rows.append(
                EstimatorConfig(name=EXTERNAL, label=name, params={"dir": str(folder.resolve()), "answers": name})
            )
    return scenario.model_copy(update={"estimators": rows})


def answers_digest(scenario: Scenario) -> dict[str, str]:
    """Hash of all answers that the rows of a scenario take, as an entry of a result's identity; nothing without such rows."""
    found = hashlib.sha256()
    made = [External(**entry.params) for entry in scenario.estimators if entry.name == EXTERNAL]
    for path in (path for external in made for path in external.files().values()):
        found.update(f"{path.parent.name}/{path.name} {file_digest(path)}\n".encode())
    return {"answers": found.hexdigest()[:16]} if made else {}


def _check_logs(folder: Path, scenario: Scenario) -> dict[str, Any]:
    """The manifest of a folder of logs of just this scenario. Raises InputError for any other folder."""
    manifest = read_manifest(folder, KIND)
    if manifest is None:
        raise InputError(f"{folder}: holds no logs of 'testbed sense SCENARIO --runs N' (no {MANIFEST} of them)")
    here, there = sensed_by(scenario), manifest.get("sensed")
    there = there if isinstance(there, Mapping) else {}
    other = tables_that_differ(*({k: v for k, v in side.items() if k not in NOT_SENSED} for side in (here, there)))
    if not other and there != here:
        other = [
            f"version {there.get('testbed')}" if there.get("testbed") != here["testbed"] else "the aircraft's model"
        ]
    if other:
        raise InputError(
            f"{folder}: its logs are of another scenario ({', '.join(other)} differ), so answers to them say nothing here; "
            f"sense {scenario.name} again with the same settings"
        )
    return manifest


class External:
    """The answers that a program of one's own gave to the logs of 'testbed sense --runs'.

    ``dir``: folder of those logs. ``answers``: name of the program's folder below ``answers/`` in it.
    """

    name = EXTERNAL
    timed = False
    """Reading an answer says nothing of the time that it took."""

    def __init__(self, dir: str, answers: str) -> None:
        if not re.fullmatch(r"[^/\\]+", answers) or answers in (".", ".."):
            raise ValueError(f"answers: '{answers}' is no name of a folder")
        self.logs = Path(dir)
        self.folder = self.logs / ANSWERS / answers

    def prepare(self, scenario: Scenario) -> None:
        """Check that the answers are to the logs of this scenario and of these runs only, before anything is computed."""
        sensed, wanted = int(_check_logs(self.logs, scenario)["runs"]), scenario.monte_carlo.runs
        if wanted > sensed:
            raise InputError(
                f"{self.logs}: holds the logs of {sensed} runs, but {wanted} are asked for: --runs {sensed}, or sense "
                f"{wanted} and answer them"
            )
        found = self.files()
        if beyond := [run for run in found if run >= sensed]:
            raise InputError(
                f"{self.folder}: answers {_runs(beyond)}, of which {self.logs} has no logs (it has {sensed})"
            )
        if not (missing := [run for run in range(wanted) if run not in found]):
            if len(found) > wanted:
                tell_user(
                    f"note: {self.folder.name}: {len(found) - wanted} answers beyond --runs {wanted} are left aside"
                )
            return
        if len(missing) == wanted:
            raise InputError(f"{self.folder}: no answer to {_runs(missing)}; run 0 is answered in {run_name(0)}.csv")
        tell_user(f"note: {self.folder.name}: no answer to {_runs(missing)} of {wanted}; they count as failed")

    def files(self) -> dict[int, Path]:
        """Run -> file of its answer. Raises InputError for a folder that is not there and for files that answer no run."""
        if not self.folder.is_dir():
            beside = [path.name for path in self.folder.parent.glob("*") if path.is_dir()]
            near = closest(self.folder.name, beside)
            raise InputError(
                f"{self.folder}: no such folder of answers" + (f"; did you mean '{near}'?" if near else "")
            )
        found: dict[int, Path] = {}
        for path in sorted(self.folder.iterdir()):
            if not re.fullmatch(r"[0-9]{6}", path.stem) or path.suffix not in SUFFIXES or not path.is_file():
                raise InputError(
                    f"{path}: answers no run; the answer to run 0 is {run_name(0)}.csv (or .parquet), and nothing else belongs here"
                )
            if (run := int(path.stem)) in found:
                raise InputError(f"{path}: a second answer to run {run}, beside {found[run].name}")
            found[run] = path
        return found

    def run(self, log: SensorLog) -> NavSolution:
        """The answer to the run that the log is of. Raises InputError that names its file and what is wrong."""
        from testbed.formats.solutions import read_solution

        stem = self.folder / run_name(log.run)
        path = next((p for p in (stem.with_suffix(suffix) for suffix in SUFFIXES) if p.is_file()), None)
        if path is None:
            raise InputError(f"{stem}.csv: no answer to run {log.run}")
        solution = read_solution(path)
        check_extent(solution, log, path)
        return solution


def check_extent(solution: NavSolution, log: SensorLog, path: Path) -> None:
    """Raise InputError where an answer is shorter or longer than its log."""
    from testbed.scoring.metrics import coverage

    t, rows = log.imu.t, f"{len(solution.t)} rows for {len(log.imu.t)} samples of the IMU"
    if (beyond := float(solution.t[-1] - t[-1])) > 1.0 or solution.t[0] < log.initial.t - 1.0:
        end = (
            f"goes on for {beyond:.6g} s after"
            if beyond > 1.0
            else f"starts {log.initial.t - solution.t[0]:.6g} s before"
        )
        raise InputError(f"{path}: {end} its log ({rows}): is it the answer to another log?")
    if gap := coverage(solution, float(t[0]), float(t[-1]), gaps_of(t)):
        raise InputError(f"{path}: {gap} ({rows})")


def _runs(runs: list[int]) -> str:
    """Runs as a message lists them."""
    more = f" and {len(runs) - MOST_NAMED} more" if len(runs) > MOST_NAMED else ""
    return f"{'run' if len(runs) == 1 else 'runs'} {', '.join(map(str, runs[:MOST_NAMED]))}{more}"
