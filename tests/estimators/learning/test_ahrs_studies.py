"""What the AHRS report has beside its runs: the log at rest of the Allan table, attitude rates, and how a table is written."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from testbed.physics.earth import gravity

STUDIES = Path(__file__).resolve().parents[3] / "reports" / "studies"


@pytest.fixture(scope="module")
def ahrs_studies():
    sys.path.insert(0, str(STUDIES))
    try:
        return importlib.import_module("ahrs_studies")
    finally:
        sys.path.remove(str(STUDIES))


@pytest.fixture(scope="module")
def log(ahrs_studies):
    return ahrs_studies.log_at_rest(60.0, 1)


def test_the_bench_is_level_and_still(log):
    """Over a minute the noise averages out; what is left are the biases of calibration, 1 mg and 0.02 °/s (1 sigma)."""
    accel, gyro = log.imu.accel - log.initial.accel_bias, log.imu.gyro - log.initial.gyro_bias
    np.testing.assert_allclose(accel.mean(0), [0.0, 0.0, -gravity(np.radians(35.7), 1000.0)], atol=5 * 0.0098)
    assert np.degrees(np.abs(gyro.mean(0))).max() < 5 * 0.02 + 0.005  # and the Earth's 0.004 °/s


def test_the_attitude_of_a_filter_turns_as_the_gyros_say_less_the_bias(log, ahrs_studies):
    """At rest a filter's corrections are small beside the gyros' noise."""
    rates = ahrs_studies.attitude_rates(log)
    assert list(rates) == ["IMU", "KF", "adaptive KF", "LSTM"]
    for label in ("KF", "adaptive KF", "LSTM"):
        left = rates[label] - (rates["IMU"] - log.initial.gyro_bias)
        rms = np.degrees(np.sqrt(np.mean(left[1000:] ** 2)))  # after twenty seconds for the start
        assert rms < 0.2  # the field's noise; that of the gyros, which the attitude follows, is 0.35 °/s


def test_a_table_has_five_digits(tmp_path, ahrs_studies):
    ahrs_studies.write_table(tmp_path / "new" / "t.csv", [{"a": 1.23456789, "b": "x"}])
    assert (tmp_path / "new" / "t.csv").read_text() == "a,b\n1.2346,x\n"
