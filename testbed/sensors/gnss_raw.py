"""Observations of GNSS satellites in the log: what ``[sensors.gnss]`` records beside its fixes with mode = "satellites"."""

from __future__ import annotations

from testbed.data.observations import GnssObservations
from testbed.data.specs import GnssSpec
from testbed.sensors.sensor import Column, Sensor

SENSOR = Sensor(
    kind="gnss_raw",
    title="GNSS satellites",
    spec=GnssSpec,
    config=None,
    samples=GnssObservations,
    sense=None,
    columns=(
        Column("sv", "sv_code", "number"),
        Column("pseudorange", "pseudorange_m", "length"),
        Column("range_rate", "range_rate_mps", "speed"),
        Column("cn0", "cn0_dbhz", "number"),
        Column("lock_time", "lock_time_s", "time"),
        Column("x_e", "x_e_{}_m", "length", tuple("xyz")),
        Column("v_e", "v_e_{}_mps", "speed", tuple("xyz")),
        Column("clock", "clock_m", "length"),
        Column("clock_rate", "clock_rate_mps", "speed"),
        Column("iono", "iono_m", "length"),
        Column("tropo", "tropo_m", "length"),
        Column("sigma", "sigma_m", "length"),
        Column("noise", "noise_m", "length"),
        Column("rate_sigma", "rate_sigma_mps", "speed"),
        Column("elevation", "elevation_rad", "number"),
        Column("azimuth", "azimuth_rad", "number"),
        Column("residual", "residual_m", "length"),
        Column("used", "used", "number"),
    ),
    rows={"lever_arm_b": ("Lever arm, body axes", 1.0, "m"), "latency_s": ("Latency", 1.0, "s")},
    rank=90,
)
