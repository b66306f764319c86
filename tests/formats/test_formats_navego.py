"""The NaveGo format: damaged .mat files are refused, and the toolbox's synthetic example is physically consistent."""

from __future__ import annotations

import contextlib
from pathlib import Path

import formats_flight
import numpy as np
import pytest
from scipy.io import loadmat, savemat

from testbed.base.errors import InputError
from testbed.formats import export_log, import_log
from testbed.formats.recording import Recording
from testbed.physics import earth

EXAMPLE = Path(__file__).resolve().parents[3] / "shared" / "data" / "navego"
needs_example = pytest.mark.skipif(not (EXAMPLE / "imu1.mat").is_file(), reason="NaveGo's example data are not here")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    trajectory = formats_flight.make_trajectory(5.0)
    export_log(formats_flight.make_log(trajectory), tmp_path, "navego", reference=trajectory)
    return tmp_path


def change(path: Path, field: str, row: int | None, value: float | None) -> None:
    """Overwrite row ``row`` of a field of the one struct in a file; without a row, remove the field."""
    name = path.stem
    struct = loadmat(path)[name][0, 0]
    fields = {key: np.array(struct[key]) for key in struct.dtype.names}
    if row is None:
        del fields[field]
    else:
        fields[field][row] = value
    savemat(path, {name: fields})


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda d: change(d / "imu.mat", "t", 7, 0.01), ["imu.mat", "imu.t", "sample 7", "increase"]),
        (lambda d: change(d / "imu.mat", "wb", 11, np.nan), ["imu.mat", "imu.wb", "sample 11", "finite"]),
        (lambda d: change(d / "gnss.mat", "lat", 3, 47.0), ["gnss.mat", "latitude", "±90°"]),
        (lambda d: change(d / "imu.mat", "fb", None, None), ["imu.mat", "no field 'fb'", "did you mean"]),
        (lambda d: change(d / "ref.mat", "vel", None, None), ["ref.mat", "no field 'vel'"]),
        (
            lambda d: (d / "imu.mat").write_bytes((d / "imu.mat").read_bytes()[:3000]),
            ["imu.mat", "corrupt or truncated"],
        ),
        (lambda d: (d / "imu.mat").write_bytes(b"not a MATLAB file at all" * 20), ["imu.mat", "corrupt or truncated"]),
        (lambda d: (d / "imu.mat").write_bytes(b""), ["imu.mat", "corrupt or truncated"]),
        (lambda d: savemat(d / "imu.mat", {"x": 1.0}), ["imu.mat", "no struct 'imu'", "variables: x"]),
        (lambda d: (d / "imu.mat").unlink(), ["imu.mat", "no such file", "gnss.mat"]),
        (
            lambda d: change(d / "imu.mat", "testbed_spec", None, None) or change(d / "imu.mat", "arw", None, None),
            ["no field 'arw'"],
        ),
    ],
)
def test_damaged_files_are_refused(damage, words: list[str], folder: Path) -> None:
    damage(folder)
    with pytest.raises(InputError) as caught:
        import_log("navego", folder)
    assert caught.value.exit_code == 2
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_every_damaged_byte_ends_in_an_input_error_or_a_recording(folder: Path) -> None:
    """Whatever scipy makes of a flipped byte, no other exception reaches the user."""
    path = folder / "gnss.mat"
    content = bytearray(path.read_bytes())
    rng = np.random.default_rng(7)
    for place in rng.integers(0, len(content), 60):
        damaged = content.copy()
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        with contextlib.suppress(InputError):
            assert isinstance(import_log("navego", folder), Recording)


def test_own_export_without_our_fields_is_plain_navego(folder: Path) -> None:
    """A MATLAB user's copy holds only NaveGo's own fields: profile and lever arm survive, levelling angles start it."""
    exact = import_log("navego", folder)
    for field in ("testbed_spec", "ini_state", "ini_std"):
        change(folder / "imu.mat", field, None, None)
    change(folder / "gnss.mat", "testbed_spec", None, None)
    plain = import_log("navego", folder)
    for triad in ("gyro", "accel"):
        ours, theirs = getattr(exact.log.imu.spec, triad), getattr(plain.log.imu.spec, triad)
        for name in ("turn_on_bias", "bias_instability", "correlation_time_s", "white_noise", "rate_random_walk"):
            assert getattr(theirs, name) == pytest.approx(getattr(ours, name), rel=1e-12), (triad, name)
    assert plain.log.gnss.spec.lever_arm_b == exact.log.gnss.spec.lever_arm_b
    assert np.abs(plain.log.initial.q_nb - exact.log.initial.q_nb).max() < 0.02


@pytest.fixture(scope="module")
def example() -> Recording:
    return import_log("navego", EXAMPLE)


@needs_example
def test_example_reference_agrees_with_gnss_within_its_noise(example: Recording) -> None:
    """The mean square of 2186 fixes' normalised errors is one within 5 sigma of its sampling error sqrt(2/n)."""
    r, g = example.reference, example.log.gnss
    rows = np.searchsorted(r.t, g.t - 1e-9)
    ned = earth.position_difference(g.lat, g.lon, g.h, r.lat[rows], r.lon[rows], r.h[rows])
    values = np.column_stack([*ned, g.v_n - r.v_n[rows]]) / g.measurement_std()
    tolerance = 5.0 * np.sqrt(2.0 / len(g.t))
    assert np.abs(np.mean(values**2, axis=0) - 1.0).max() < tolerance


@needs_example
def test_example_imu_is_reference_motion_plus_stated_errors(example: Recording) -> None:
    """Bias below 1.1 turn-on sigma as the toolbox draws it, scatter that of the stated density where motion is smooth."""
    r, imu = example.reference, example.log.imu
    assert np.array_equal(r.t[1:], imu.t)
    assert example.log.initial.t == r.t[0]
    for measured, implied, spec in ((imu.gyro, r.w_ib_b, imu.spec.gyro), (imu.accel, r.f_b, imu.spec.accel)):
        error = measured - implied[1:]
        assert (np.abs(error.mean(axis=0)) < 1.2 * spec.turn_on_bias).all()
        sigma = spec.white_noise * np.sqrt(imu.spec.rate_hz)
        scatter = 1.4826 * np.median(np.abs(error - np.median(error, axis=0)), axis=0)
        assert np.abs(scatter / sigma - 1.0).max() < 0.02  # the median's sampling error for 87,449 samples is 0.4 %


@needs_example
def test_example_samples_are_means_over_the_interval_before(example: Recording) -> None:
    """Specific force down, regressed on the reference's change, lags the interval's middle by less than half of dt/2."""
    r, imu = example.reference, example.log.imu
    slope = np.gradient(r.f_b[:, 2]) / r.dt
    smooth = np.abs(imu.accel - r.f_b[1:] - np.median(imu.accel - r.f_b[1:], axis=0)).max(axis=1) < 0.25
    smooth = np.convolve(~smooth, np.ones(5), "same") == 0
    error = (imu.accel[:, 2] - r.f_b[1:, 2])[smooth]
    offset = np.sum((error - error.mean()) * slope[1:][smooth]) / np.sum(slope[1:][smooth] ** 2)
    assert abs(offset) < 0.25 * r.dt
