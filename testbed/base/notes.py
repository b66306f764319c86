"""Notes of a run: what a scenario says without effect. Each is told once, kept in the manifest and shown in the report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.errors import InputError, shown
from testbed.base.resources import scenario_root
from testbed.data.registry import make_estimator
from testbed.flight.own import TrajectoryConfig

if TYPE_CHECKING:
    from testbed.scenario import Scenario


def notes_of(scenario: Scenario) -> list[str]:
    """The notes of a checked scenario, in sentences. Raises what reading its recording and making its estimators raises."""
    notes = _of_recording(scenario) if scenario.recording is not None else _of_flight(scenario)
    recorded = _recorded(scenario)
    made = [make_estimator(entry.name, **entry.params) for entry in scenario.estimators]
    used = [_sensors_of(estimator) for estimator in made]
    # what an estimator itself has to tell, such as how old its weights are
    told = (
        f"{entry.row}: {note}" for entry, m in zip(scenario.estimators, made, strict=True) for note in _own_notes(m)
    )
    notes += dict.fromkeys(told)
    if None not in used:
        # the observations of satellites are of the sensor gnss, as its fixes are
        wanted = {"gnss" if name == "gnss_raw" else name for names in used for name in names or ()}
        idle = [kind for kind in recorded if kind != "gnss_raw" and kind not in wanted]
        notes += [f"no estimator of this run uses the sensor {kind}" for kind in idle]
    return notes


def _own_notes(estimator: Any) -> tuple[str, ...]:
    return tuple(getattr(estimator, "notes", ()))


def _of_flight(scenario: Scenario) -> list[str]:
    """A shipped scenario says how its flights may be drawn, ready for who sets ``vary``; in a file of one's own that is a slip."""
    settings = scenario.monte_carlo
    own = Path(scenario.source_path).parent != scenario_root().resolve()
    own = own or any(key.startswith("monte_carlo.disperse") for key in scenario.settings)
    notes = []
    if settings.disperse and "manoeuvres" not in settings.vary and own:
        notes += ["monte_carlo.disperse has no effect: monte_carlo.vary does not name 'manoeuvres'"]
    if isinstance(scenario.flight, TrajectoryConfig):
        from testbed.flight.track import notes_of_track

        notes += notes_of_track(scenario.flight)
    return notes


def _of_recording(scenario: Scenario) -> list[str]:
    from testbed.formats import load_recording

    assert scenario.recording is not None
    recording = load_recording(scenario.recording, scenario.folder)
    if scenario.sensors is not None:
        return [
            f"the recording's own sensors ({', '.join(['imu', *recording.log.aiding])}) are not used: [sensors] sense its reference anew"
        ]
    notes = list(recording.notes)
    idle = [f"monte_carlo.{key}" for key in ("vary", "disperse") if key in scenario.monte_carlo.model_fields_set]
    idle += [f"initial.{key}" for key in sorted(scenario.initial.model_fields_set)]
    return notes + [f"{key} has no effect on a recording" for key in idle]


def _recorded(scenario: Scenario) -> list[str]:
    """The aiding sensors that the run's log has."""
    if scenario.recording is None or scenario.sensors is not None:
        from testbed.sensors.registry import SENSORS

        return [kind for kind in SENSORS if getattr(scenario.sensors, kind, None) is not None]
    from testbed.formats import load_recording

    return list(load_recording(scenario.recording, scenario.folder).log.aiding)


def check_sensors(estimator: Any) -> None:
    """Raise InputError where an estimator says that it uses a sensor which no log has."""
    from testbed.sensors.registry import SAMPLES

    told, known = _sensors_of(estimator), ["imu", *SAMPLES]
    for name in told or ():
        if name not in known:
            raise InputError(
                f"'sensors' of estimator '{estimator.name}' names {shown(name)}; valid: {', '.join(known)}"
            )


def _sensors_of(estimator: Any) -> tuple[str, ...] | None:
    """What an estimator says that it uses (``sensors``); None where it does not say.

    A subclass with a ``run`` of its own does not inherit the word of its parent.
    """
    for kind in type(estimator).__mro__:
        if "sensors" in vars(kind):
            return _names(estimator.sensors)
        if "run" in vars(kind):
            return _names(estimator.sensors) if "sensors" in getattr(estimator, "__dict__", {}) else None
    return None


def _names(told: Any) -> tuple[Any, ...]:
    """Several names, or a single thing that was given in place of them."""
    return tuple(told) if isinstance(told, tuple | list | set | frozenset) else (told,)
