"""The field that a recording's magnetometer is compared with: stated, or measured while the start is levelled."""

import numpy as np
import pandas as pd
import pytest

from testbed.base.errors import InputError
from testbed.formats import import_log
from testbed.physics.rotations import euler_to_quat, quats_to_matrices

FIELD_N = np.array([15.0, 3.0, 41.0])
ANGLES = (0.3, -0.2, 1.1)
"""Roll, pitch, yaw of a box that lies still, rad."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A box at rest for 20 s with a reference; nothing in its files states the field."""
    out = tmp_path_factory.mktemp("box")
    t, q = np.arange(1, 2001) / 100.0, np.array(euler_to_quat(*ANGLES))
    c = quats_to_matrices(q[None])[0]
    rows = {f"gyro_{a}_radps": np.zeros(2000) for a in "xyz"} | {
        f"accel_{a}_mps2": np.full(2000, v) for a, v in zip("xyz", c.T @ [0.0, 0.0, -9.81], strict=True)
    }
    pd.DataFrame({"time_s": t} | rows).to_csv(out / "imu.csv", index=False)
    field = {f"mag_{a}_ut": np.full(2000, v) for a, v in zip("xyz", c.T @ FIELD_N, strict=True)}
    pd.DataFrame({"time_s": t} | field).to_csv(out / "mag.csv", index=False)
    still = {"lat_deg": 52.0, "lon_deg": 13.0, "alt_m": 50.0, "v_north_mps": 0.0, "v_east_mps": 0.0, "v_down_mps": 0.0}
    still |= {f"q_nb_{k}": v for k, v in enumerate(q)}
    pd.DataFrame({"time_s": np.concatenate([[0.0], t])} | still).to_csv(out / "reference.csv", index=False)
    return out


def loaded(folder, mag, **initial):
    keys = {"start": "reference", "heading": "mag"} | initial
    return import_log("table", folder, imu={"model": "ADIS16448"}, mag=mag, initial=keys)


def horizontal_and_down(recording):
    north, east, down = recording.log.mag.spec.field_n
    return np.hypot(north, east), down


def test_norm_and_dip_are_measured_where_nothing_states_them(folder):
    """At rest they are the field's own, whatever the declination; the run is told."""
    recording = loaded(folder, {"model": "ADIS16448"})
    np.testing.assert_allclose(horizontal_and_down(recording), (np.hypot(15.0, 3.0), 41.0), rtol=1e-3)  # of g at 52°
    (told,) = [note for note in recording.notes if "first 2 s" in note]
    assert "43.8 µT" in told and "69.5°" in told and "field_ut" in told


def test_a_scenario_states_field_or_declination(folder):
    """The field gives its declination; a declination alone leaves norm and dip to the measurement."""
    stated = loaded(folder, {"model": "ADIS16448", "field_ut": [15.0, 3.0, 41.0]})
    assert stated.log.mag.spec.field_n == (15.0, 3.0, 41.0)
    assert stated.log.mag.spec.declination == pytest.approx(np.arctan2(3.0, 15.0))
    turned = loaded(folder, {"declination_deg": 11.0})
    assert turned.log.mag.spec.declination == pytest.approx(np.radians(11.0))
    np.testing.assert_allclose(horizontal_and_down(turned), (np.hypot(15.0, 3.0), 41.0), rtol=1e-3)
    east = loaded(folder, {}, declination_deg=11.0)
    assert east.log.mag.spec.field_n == pytest.approx(turned.log.mag.spec.field_n)
    for recording in (stated, turned, east):
        assert not any("World Magnetic Model" in note for note in recording.notes)


def test_a_field_that_is_off_is_told(folder):
    """A stated field of 60 µT where 44 are measured: 27 % less."""
    recording = loaded(folder, {"field_ut": [20.0, 0.0, 56.6]})
    assert any("-27 % from the 60.0 µT" in note for note in recording.notes)
    assert not any("% from the" in note for note in loaded(folder, {"field_ut": [15.0, 3.0, 41.0]}).notes)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"field_ut": [1.0, 2.0]}, "field_ut is .* expected"),
        ({"field_ut": [0.0, 0.0, 45.0]}, "horizontal"),
        ({"field_ut": [15.0, 3.0, float("nan")]}, "field_ut is"),
        ({"declination_deg": 200.0}, "declination_deg is 200"),
        ({"declination_deg": "east"}, "declination_deg is"),
        ({"field_ut": [15.0, 3.0, 41.0], "declination_deg": 3.0}, "leave out"),
    ],
)
def test_what_cannot_be_a_field_is_refused(folder, table, words):
    with pytest.raises(InputError, match=words):
        loaded(folder, table)
