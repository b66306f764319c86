"""Sensors: what an IMU and the sensors beside it (GNSS, magnetometer, barometer, odometer ...) record on a flight.

`sense_flight` for a flight, `static_log` for a sensor at rest, `list_sensors` for the catalogue. Models and their sources
are in the modules, one per sensor; SI units and radians.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from testbed.sensors.draws import VARIED, Draws

if TYPE_CHECKING:
    from testbed.data.records import SensorErrors, SensorLog, Trajectory
    from testbed.sensors.config import InitialConfig
    from testbed.sensors.registry import SensorsConfig


def __getattr__(name: str) -> Any:
    """`list_sensors`, with the registry that it needs, when it is first asked for."""
    if name == "list_sensors":
        from testbed.sensors.registry import list_sensors

        return list_sensors
    raise AttributeError(f"module 'testbed.sensors' has no attribute '{name}'")


__all__ = ["list_sensors", "sense_flight", "static_log"]


def sense_flight(
    sensors: SensorsConfig,
    initial: InitialConfig,
    trajectory: Trajectory,
    seed: int,
    run: int = 0,
    vary: Collection[str] = VARIED,
) -> tuple[SensorLog, SensorErrors]:
    """Record a flight in Monte Carlo run ``run``; also the true biases and drawn constants, for scoring only.

    What ``vary`` does not name (``noise``, ``turn_on``, ``alignment``, ``outages``) is drawn as in run 0. Raises
    InputError for a configuration that does not fit the flight.
    """
    from testbed.data.records import SensorErrors, SensorLog
    from testbed.sensors.imu import motion_of, sense_imu
    from testbed.sensors.initial import draw_initial
    from testbed.sensors.registry import SENSORS

    draws = Draws(seed, run, vary)
    imu, bias, constants = sense_imu(sensors.imu, motion_of(trajectory, sensors.imu.rate_hz), draws)
    aiding: dict[str, Any] = {}
    for kind, sensor in SENSORS.items():
        if sensor.sense is not None and (config := getattr(sensors, kind)) is not None:
            made, drawn = sensor.sense(config, trajectory, draws, imu.spec.lever_arm_b)
            aiding |= made if isinstance(made, dict) else {kind: made}
            constants |= drawn
    if initial.align_at_rest_s is not None:
        from testbed.sensors.rest_alignment import after, align_at_rest

        start, rest = align_at_rest(initial, trajectory, imu, aiding.get("mag"), draws)
        log = SensorLog(rest, start, name=trajectory.name, aiding=after(aiding, start.t))
        later = imu.t > start.t + 1e-9
        return log, SensorErrors(rest.t, bias["accel"][later], bias["gyro"][later], constants)
    start = draw_initial(initial, trajectory, imu.spec, {name: values[0] for name, values in bias.items()}, draws)
    log = SensorLog(imu, start, name=trajectory.name, aiding=aiding)
    return log, SensorErrors(imu.t, bias["accel"], bias["gyro"], constants)


def static_log(
    model: str,
    rate_hz: float = 100.0,
    duration_s: float = 3600.0,
    seed: int = 0,
    lat_deg: float = 45.0,
    **settings: Any,
) -> SensorLog:
    """An IMU of the catalogue at rest, level and heading north. ``settings`` are keys of ``[sensors.imu]``.

    Raises InputError for an unknown model or setting.
    """
    import math

    import numpy as np

    from testbed.base.errors import InputError
    from testbed.base.schema import validate
    from testbed.data.records import InitialState, SensorLog
    from testbed.physics.earth import earth_rate_n, gravity
    from testbed.sensors.config import ImuConfig
    from testbed.sensors.imu import Motion, sense_imu
    from testbed.sensors.initial import SMALLEST_STD

    n = round(rate_hz * duration_s) if rate_hz > 0.0 and math.isfinite(rate_hz * duration_s) else 0
    if n < 2:
        raise InputError(
            f"static_log: rate_hz {rate_hz:g} and duration_s {duration_s:g} must be positive and give samples"
        )
    config = validate(ImuConfig, {"model": model} | settings, "static_log")
    lat = math.radians(lat_deg)
    rest = Motion(
        start=0.0,
        t=np.arange(1, n + 1) / rate_hz,
        w_ib_b=np.broadcast_to(np.array(earth_rate_n(lat)), (n, 3)),
        f_b=np.broadcast_to(np.array([0.0, 0.0, -gravity(lat, 0.0)]), (n, 3)),
    )
    imu, _, _ = sense_imu(config, rest, Draws(seed))
    still = np.zeros(3)
    start = InitialState(0.0, lat, 0.0, 0.0, still, np.array([1.0, 0.0, 0.0, 0.0]), still, still, SMALLEST_STD)
    return SensorLog(imu, start, name=f"{model} at rest")
