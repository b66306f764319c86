"""The catalogue: every entry is whole, units are right, and a user's mistakes get one clear message."""

from __future__ import annotations

import numpy as np
import pytest

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.physics.earth import G0
from testbed.sensors import catalog, list_sensors, static_log
from testbed.sensors.config import ImuConfig, MagConfig

ENTRIES = [(kind, name) for kind, names in list_sensors().items() for name in names]


@pytest.mark.parametrize(("kind", "name"), ENTRIES)
def test_every_entry_becomes_a_specification_with_a_source(kind, name):
    spec = catalog.specification(kind, name)
    assert spec.name == name
    assert list_sensors()[kind][name]
    assumed = catalog.entry(kind, name).get("assumed", [])
    assert set(assumed) <= set(catalog.entry(kind, name))


def test_units():
    """Each by hand from the data sheet: 2 °/√h is 2/60 °/√s, 25.2 °/h is 0.007 °/s, 54 °/√h³ is 54/3600^1.5 °/s/√s."""
    spec = catalog.specification("imu", "ADIS16405")
    assert spec.gyro.white_noise == pytest.approx(np.radians(2.0 / 60.0))
    assert spec.gyro.bias_instability == pytest.approx(np.radians(25.2 / 3600.0))
    assert spec.gyro.range == pytest.approx(np.radians(300.0))
    assert spec.gyro.g_sensitivity == pytest.approx(np.radians(0.05) / 9.80665)
    assert spec.accel.white_noise == pytest.approx(0.2 / 60.0)
    assert spec.accel.turn_on_bias == pytest.approx(0.05 * G0)
    assert spec.accel.resolution == pytest.approx(0.00333 * G0)
    walk = catalog.specification("imu", "ahrs-lstm-2022").gyro.rate_random_walk
    assert walk == pytest.approx(np.radians(54.0) / 216000.0)
    mag = catalog.specification("mag", "ADIS16405")
    assert mag.resolution == pytest.approx(0.05)  # 0.5 mgauss in µT
    assert mag.range == pytest.approx(250.0)


def test_per_sample_noise_of_the_kfann_paper():
    """0.0002 rad/s and 0.02 m/s² per sample at 100 Hz."""
    spec = catalog.specification("imu", "kfann-2018")
    assert spec.gyro.white_noise * np.sqrt(100.0) == pytest.approx(0.0002)
    assert spec.accel.white_noise * np.sqrt(100.0) == pytest.approx(0.02)


def test_magnetometer_noise_density_goes_with_the_rate():
    low, high = (
        validate(MagConfig, {"model": "ADIS16488", "rate_hz": r}, "test").spec().noise_sigma for r in (10.0, 40.0)
    )
    assert high == pytest.approx(2.0 * low)
    assert low == pytest.approx(0.0054 * np.sqrt(5.0))
    given = validate(MagConfig, {"model": "ADIS16488", "noise_ut": 0.3}, "test").spec()
    assert given.noise_sigma == pytest.approx(0.3)


def test_an_override_wins_in_any_unit():
    config = validate(ImuConfig, {"model": "ADIS16405", "gyro_bias_instability_dph": 36.0}, "test")
    assert config.spec(100.0).gyro.bias_instability == pytest.approx(np.radians(0.01))
    assert config.spec(100.0).gyro.white_noise == catalog.specification("imu", "ADIS16405").gyro.white_noise


def test_a_users_own_catalogue(tmp_path):
    own = tmp_path / "own.toml"
    own.write_text('[imu.Mine]\nsource = "bench"\ngyro_arw_dpsqrth = 1.5\naccel_range_g = 4\n')
    spec = validate(ImuConfig, {"model": "Mine", "file": str(own)}, "test").spec(100.0)
    assert spec.gyro.white_noise == pytest.approx(np.radians(1.5 / 60.0))
    assert spec.accel.range == pytest.approx(4.0 * G0)
    assert validate(ImuConfig, {"model": "ADIS16405", "file": str(own)}, "test").model == "ADIS16405"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[imu.A]\nsource = "x"\ngyro_arw_dpsqrt = 1.0\n', "'gyro_arw_dpsqrt'; did you mean 'gyro_arw_dpsqrth'"),
        ('[imu.A]\nsource = "x"\ngyro_arw_dpsqrth = "1"\n', "finite number"),
        ('[imu.A]\nsource = "x"\ngyro_arw_dpsqrth = -1\n', "negative"),
        ('[imu.A]\nsource = "x"\ngyro_arw_dpsqrth = nan\n', "finite number"),
        ('[imu.A]\nsource = "x"\nrate_hz = 0\n', "positive"),
        ('[imu.A]\nsource = "x"\ngyro_range_dps = 1\ngyro_range_radps = 1\n', "say the same thing"),
        ("[imu.A]\ngyro_arw_dpsqrth = 1.0\n", "source"),
        ('[imus.A]\nsource = "x"\n', r"\[imus\]; did you mean 'imu'"),
        ("imu = 3\n", "table"),
        ("[imu.A\n", "not valid TOML"),
        ('[imu.B]\nsource = "x"\n', "no imu named 'A'"),
    ],
)
def test_wrong_catalogues_are_refused(tmp_path, text, message):
    own = tmp_path / "own.toml"
    own.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        validate(ImuConfig, {"model": "A", "file": str(own)}, "scenario.toml")
    assert "own.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"model": "ADIS1640"}, "did you mean 'ADIS16405'"),
        ({"modle": "ADIS16405"}, "did you mean 'model'"),
        ({"gyro_arw": 1.0}, "gyro_arw_dpsqrth"),
        ({"disable": ["quantization"]}, "quantisation"),
        ({"rate_hz": "100"}, "number"),
        ({"file": "/nowhere.toml"}, "nowhere.toml"),
        ({"gyro_nonlinearity_pctfs": 0.1}, "gyro_range"),
        ({"temperature": {"time_s": [0.0, 0.0], "celsius": [1.0, 2.0]}}, "increase"),
        ({"vibration": {"tones": [{"accel_g": [1.0, 0.0, 0.0]}]}}, "order"),
        ({"lever_arm_m": [1.0, 2.0]}, "lever_arm_m"),
    ],
)
def test_wrong_imu_tables_are_refused(table, message):
    with pytest.raises(InputError, match=message):
        validate(ImuConfig, table, "scenario.toml")


def test_static_log_refuses_nonsense():
    for bad in ({"rate_hz": 0.0}, {"duration_s": float("inf")}, {"duration_s": -1.0}):
        with pytest.raises(InputError, match="static_log"):
            static_log("ideal", **bad)
    with pytest.raises(InputError, match="did you mean"):
        static_log("ADIS1644")
