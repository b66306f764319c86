"""A composition of every kind of part runs side by side as it runs alone."""

import numpy as np
import pytest
from analytic_flight import analytic_flight
from test_parts_consistency import FULL, GNSS, UAV

from estimators.core.search import Searcher
from estimators.methods.eskf import Eskf
from testbed.base.schema import validate
from testbed.physics import earth
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig


@pytest.mark.parametrize("error", ["phi", "invariant"])
def test_lanes_are_the_filter(error):
    """RMSE of position (m) and velocity (m/s) of nine filters that differ in noise, each against its own run: to 1e-7, what
    series for sines instead of the library's leave after 1500 steps of errors of metres."""
    truth = analytic_flight(15.0, 100.0, vigour=0.5)
    sensors = {"imu": {"model": "ADIS16448"}, "gnss": GNSS, **UAV}
    log, _ = sense_flight(validate(SensorsConfig, sensors, "sensors"), InitialConfig(), truth, 5)
    parts = ((*FULL, "baro-bias", "mag-bias"), ("gnss", "baro", "mag", "heading"))
    filters = [Eskf(*parts, error=error, noise_scale={"gyro": 1.0 + 0.3 * k}) for k in range(9)]
    rmse, deviance = Searcher(filters[0].composition, log, truth, 1).batch(filters)
    for one, scored in zip(filters, rmse, strict=True):
        solution = one.run(log)
        k = np.searchsorted(truth.t, solution.t - 1e-6)
        north, east = earth.metres_per_radian(truth.lat[k], truth.h[k])
        place = [(solution.lat - truth.lat[k]) * north, (solution.lon - truth.lon[k]) * east, solution.h - truth.h[k]]
        errors = np.column_stack([*place, solution.v_n - truth.v_n[k]])
        np.testing.assert_allclose(scored[:6], np.sqrt((errors**2).mean(axis=0)), rtol=1e-7)
    assert np.isfinite(deviance).all() and len(set(rmse[:, 0])) == 9
