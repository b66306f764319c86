"""The makers of truth: JSBSim flies a script, a car drives one, or a file says how a vehicle moved.

`fly_flight` is the one call; flights are cached by the hash of all that determines them. SI units and radians.
"""

from __future__ import annotations

from pathlib import Path

from testbed.data.records import Trajectory
from testbed.flight.aircraft import AnyAircraft, Multirotor, list_aircraft, load_aircraft
from testbed.flight.config import FlightConfig
from testbed.flight.drive import DriveConfig, drive
from testbed.flight.own import TrajectoryConfig

__all__ = ["DriveConfig", "FlightConfig", "TrajectoryConfig", "fly_flight", "list_aircraft"]


def fly_flight(
    config: FlightConfig | DriveConfig | TrajectoryConfig, seed: int = 0, use_cache: bool = True
) -> Trajectory:
    """Fly ``config`` and return the truth at ``config.rate_hz``. ``seed`` seeds the turbulence unless the wind has its own.
    A drive and a file's trajectory are made anew each time, which takes less than reading them would.

    Raises FlightError, which names the manoeuvre and the time, when the aircraft cannot fly the script, and InputError
    for an unknown aircraft.
    """
    if isinstance(config, DriveConfig):
        return drive(config)
    if isinstance(config, TrajectoryConfig):
        from testbed.flight.track import fly_track

        return fly_track(config)
    from testbed.flight import cache
    from testbed.flight.trial import try_aircraft

    aircraft, folder = load_aircraft(config.aircraft)
    seed = config.wind.seed if config.wind.seed is not None else seed
    path = cache.path_of(config, folder, seed)
    if use_cache and (trajectory := cache.load(path)) is not None:
        return trajectory
    try_aircraft(config, folder)
    if not use_cache:
        return _fly(config, aircraft, folder, seed)
    # what the file gives back differs in the last bit of an angle: the first use must not differ from the later ones
    cache.store(_fly(config, aircraft, folder, seed), path)
    return cache.load(path) or _fly(config, aircraft, folder, seed)


def _fly(config: FlightConfig, aircraft: AnyAircraft, folder: Path, seed: int) -> Trajectory:
    import numpy as np

    from testbed.base.errors import FlightError
    from testbed.flight.driver import fly_script
    from testbed.flight.multirotor import fly_multirotor
    from testbed.flight.script import FEWEST_SAMPLES
    from testbed.flight.truth import make_trajectory
    from testbed.physics.earth import G0

    if isinstance(aircraft, Multirotor):
        flown = fly_multirotor(config, aircraft, folder, seed)
    else:
        flown = fly_script(config, aircraft, folder, seed)
    rows = len(flown.v_n)
    if rows < FEWEST_SAMPLES:
        raise FlightError(f"a flight of {rows} samples is too short")
    t = np.arange(rows) / config.rate_hz
    extra = {name: np.interp(t, flown.air_t, flown.air[:, i]) for i, name in enumerate(flown.air_names)}
    del t
    v_n, q_nb, start, phases = flown.v_n, flown.q_nb, flown.start, flown.phases
    del flown  # with the air data at their own rate, a tenth of a long flight's memory
    truth = make_trajectory(v_n, q_nb, config.rate_hz, start, extra, phases, config.aircraft)
    extra["load_factor"] = -truth.f_b[:, 2] / G0
    return truth
