"""The four arrows of the bench as functions on a scenario: fly, sense, estimate (an estimator's own ``run``), score.

The Monte Carlo runner and the Python API go through the same four.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.base.streams import stream
from testbed.data.records import NavSolution, SensorErrors, SensorLog, Trajectory
from testbed.scenario import Scenario, WindowConfig, load_scenario, set_key
from testbed.scenario.windows import Window, resolve_windows

if TYPE_CHECKING:
    import pandas as pd

    from testbed.flight.config import FlightConfig
    from testbed.flight.drive import DriveConfig
    from testbed.flight.own import TrajectoryConfig

KEPT = ("extra", "phases", "name", "own_times", "known", "arm_b")
"""Of a trajectory that is cut: what is no array of rows."""


@contextmanager
def _named(scenario: Scenario, section: str) -> Iterator[None]:
    """Put the scenario's file and section in front of what is found wrong with them only when they are used."""
    try:
        yield
    except InputError as error:
        if scenario.source_path in str(error):
            raise
        place = "" if str(error).startswith("[") else f"[{section}] "
        raise type(error)(f"{scenario.source_path}: {place}{error}") from None


def flight_varies(scenario: Scenario) -> bool:
    """Whether each Monte Carlo run needs a flight of its own."""
    if scenario.recording is not None and scenario.recording.holdout is not None:
        return scenario.recording.holdout.draw is not None
    vary = scenario.monte_carlo.vary
    return scenario.flight is not None and (
        "turbulence" in vary or ("manoeuvres" in vary and bool(scenario.monte_carlo.disperse))
    )


def flight_of_run(scenario: Scenario, run: int) -> tuple[FlightConfig | DriveConfig | TrajectoryConfig, int]:
    """The flight that run ``run`` flies, and its turbulence seed."""
    if scenario.flight is None:
        raise InputError(f"{scenario.source_path}: the scenario is a recording; there is nothing to fly")
    config, settings = scenario.flight, scenario.monte_carlo
    if "manoeuvres" in settings.vary and settings.disperse:
        data = config.model_dump(mode="json", exclude_none=True)
        where = f"{scenario.source_path}: monte_carlo.disperse"
        for pattern, distribution in settings.disperse.items():
            for key, own in _dispersed(data, pattern, distribution.factor is not None, where):
                rng = stream(settings.seed, run, f"flight.{key}")
                set_key(data, key, distribution.draw(rng, own), where)
        config = validate(type(config), data, f"{scenario.source_path}: flight of run {run}")
    seed = settings.seed + run if "turbulence" in settings.vary else settings.seed
    return config, seed


def _dispersed(data: dict[str, Any], pattern: str, needs_value: bool, where: str) -> list[tuple[str, float]]:
    """The keys of a flight that a key of ``disperse`` means, with their numbers (NaN where there is none to start from)."""
    head, star, tail = pattern.partition(".*.")
    rows = data.get(head, []) if star else [data]
    keys = [f"{head}.{k}.{tail}" for k, row in enumerate(rows) if tail in row] if star else [pattern]
    if not keys:
        raise InputError(f"{where}: '{pattern}': no row of '{head}' has '{tail}'")
    found = []
    for key in keys:
        node: Any = data
        for part in key.split("."):
            inside = isinstance(node, list) and part.isdigit() and int(part) < len(node)
            node = node[int(part)] if inside else node.get(part) if isinstance(node, dict) else None
        number = isinstance(node, int | float) and not isinstance(node, bool)
        if needs_value and not number:
            raise InputError(f"{where}: '{key}': the flight has no such number to multiply by a factor")
        found.append((key, float(node) if number else np.nan))
    return found


def fly(scenario: Scenario | str | Path, run: int = 0) -> Trajectory:
    """The truth of a run: the JSBSim flight (cached), the trajectory of a file, or the reference of a recording.

    A text is the name of a shipped scenario or the path of a file, here and in `sense` and `score`. Raises FlightError when the aircraft cannot fly the script, InputError when a recording has no reference.
    """
    scenario = loaded(scenario)
    if scenario.recording is not None:
        truth = _recorded_truth(scenario, run)
        if scenario.sensors is None:
            return truth
        from testbed.flight.track import sensed_anew

        with _named(scenario, "recording"):
            return sensed_anew(truth, scenario.sensors.imu.rate_hz)
    from testbed.flight import fly_flight

    with _named(scenario, "flight"):
        config, seed = flight_of_run(scenario, run)
        return fly_flight(config, seed)


def loaded(scenario: Scenario | str | Path) -> Scenario:
    """A scenario as it is, or by the name of a shipped one or the path of a file."""
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)


def _recorded_truth(scenario: Scenario, run: int) -> Trajectory:
    """The reference of a recording, else its withheld fixes."""
    from testbed.formats import holdout, load_recording

    assert scenario.recording is not None
    if scenario.recording.holdout is not None and scenario.sensors is not None:
        raise InputError(
            f"{scenario.source_path}: [recording.holdout] withholds fixes that [sensors] replaces; leave one of them out"
        )
    recording = load_recording(scenario.recording, scenario.folder)
    if recording.reference is not None:
        return recording.reference
    if scenario.recording.holdout is None:
        raise InputError(
            f"{scenario.source_path}: this recording has no reference trajectory, so nothing can be scored;"
            " [recording.holdout] withholds fixes to score against"
        )
    return holdout.withheld(recording.log, _withheld_windows(scenario, recording.log, run), recording.position_only)


def _withheld_windows(scenario: Scenario, log: SensorLog, run: int) -> tuple[tuple[float, float], ...]:
    from testbed.formats import holdout

    assert scenario.recording is not None and scenario.recording.holdout is not None
    seed = scenario.monte_carlo.seed
    return holdout.windows_of(scenario.recording.holdout, log, seed, run, scenario.source_path)


def sense(
    scenario: Scenario | str | Path, trajectory: Trajectory, seed: int | None = None, run: int = 0
) -> tuple[SensorLog, SensorErrors | None]:
    """What the sensors record on a trajectory in Monte Carlo run ``run``; ``seed`` defaults to the scenario's.

    For a recording without ``[sensors]``: the recording and None.
    """
    scenario = loaded(scenario)
    if scenario.recording is not None and scenario.sensors is None:
        from testbed.formats import holdout, load_recording

        log = load_recording(scenario.recording, scenario.folder).log
        if scenario.recording.holdout is not None:
            log = holdout.withhold(log, _withheld_windows(scenario, log, run))
        return replace(log, run=run), None
    from testbed.sensors import sense_flight

    if scenario.sensors is None:
        raise InputError(f"{scenario.source_path}: no [sensors.imu]")
    settings = scenario.monte_carlo
    seed = settings.seed if seed is None else seed
    with _named(scenario, "sensors"):
        log, errors = sense_flight(scenario.sensors, scenario.initial, trajectory, seed, run, vary=settings.vary)
    return replace(log, run=run), errors


def windows_of(scenario: Scenario, trajectory: Trajectory, log: SensorLog | None = None) -> list[Window]:
    """The scoring windows of a scenario on this flight and log."""
    outages = log.gnss.outages if log is not None and log.gnss is not None else ()
    configs = list(scenario.windows)
    withheld = scenario.recording is not None and scenario.recording.holdout is not None
    if withheld and not any(config.kind == "outages" for config in configs):
        configs.append(WindowConfig(kind="outages"))
    with _named(scenario, "windows"):
        return resolve_windows(configs, trajectory, outages)


def truth_at_imu(trajectory: Trajectory, log: SensorLog) -> Trajectory:
    """The truth of what the estimators navigate: the point where the IMU sits, which ``lever_arm_m`` may set apart, from the
    time on at which they start, which an alignment may delay."""
    if (first := int(np.searchsorted(trajectory.t, log.initial.t - 1e-9))) > 0:
        rows = {f.name: getattr(trajectory, f.name)[first:] for f in fields(trajectory) if f.name not in KEPT}
        extra = {name: values[first:] for name, values in trajectory.extra.items()}
        trajectory = replace(trajectory, **rows, extra=extra)
    arm = np.array(log.imu.spec.lever_arm_b)
    if not arm.any():
        return trajectory
    from testbed.physics.interpolate import point_state

    lat, lon, h, v_n = point_state(trajectory, trajectory.t, arm)
    return replace(trajectory, lat=lat, lon=lon, h=h, v_n=v_n)


def score(
    scenario: Scenario | str | Path,
    trajectory: Trajectory,
    solution: NavSolution,
    log: SensorLog | None = None,
    errors: SensorErrors | None = None,
) -> pd.DataFrame:
    """Errors of a solution as a table (window, metric, value); the metric names are in `testbed.scoring.metrics`.

    With ``log`` also the windows of drawn outages, the differences to GNSS, and an IMU's lever arm; with ``errors`` also
    ``nees_bias``.
    """
    from testbed.scoring import metrics

    scenario = loaded(scenario)
    gnss: Any = log.gnss if log is not None else None
    truth = trajectory if log is None else truth_at_imu(trajectory, log)
    return metrics.score(truth, solution, windows_of(scenario, trajectory, log), errors=errors, gnss=gnss)
