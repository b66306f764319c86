"""A recording whose GNSS are RINEX files: a receiver at rest on a known place, beside a simulated IMU at rest on the same."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from testbed.base.errors import InputError
from testbed.data.registry import make_estimator
from testbed.formats import import_log
from testbed.formats.holdout import withhold
from testbed.physics import earth, ecef

DATA = Path(__file__).parents[3] / "shared" / "data" / "rinex"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="needs the shared RINEX files")
PLACE = ecef.ecef_to_geodetic(-3962108.6617, 3381309.5232, 3668678.6410)
NOON_UTC = 1616155200.0 - 18.0
"""2021-03-19 12:00:00 GPST as Unix time: GPST leads by 18 s since 2017 (IERS Bulletin C)."""
SENSORS = {"imu": {"model": "ADIS16448"}, "initial": {"yaw_deg": 0.0, "yaw_std_deg": 5.0}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two minutes at 50 Hz, level and to the north, from a second before noon; white noise of the ADIS16448's size."""
    out = tmp_path_factory.mktemp("rinex")
    rng = np.random.default_rng(1)
    t = NOON_UTC - 1.0 + np.arange(6000) / 50.0
    rate = np.array(earth.earth_rate_n(PLACE[0])) + np.radians(0.1) * rng.standard_normal((6000, 3))
    force = [0.0, 0.0, -earth.gravity(PLACE[0], PLACE[2])] + 0.02 * rng.standard_normal((6000, 3))
    names = [f"gyro_{a}_radps" for a in "xyz"] + [f"accel_{a}_mps2" for a in "xyz"]
    frame = pd.DataFrame(np.hstack([rate, force]), columns=names)
    frame.insert(0, "time_s", t)
    frame.to_csv(out / "imu.csv", index=False)
    text = (DATA / "SEPT078M_GE.21O").read_text().splitlines(keepends=True)
    # the header and the first two minutes
    ends = [k for k, line in enumerate(text) if line.startswith("> 2021 03 19 12 02 ")]
    (out / "site.21O").write_text("".join(text[: ends[0]]))
    (out / "SEPT078M.21P").write_bytes((DATA / "SEPT078M.21P").read_bytes())
    return out


def test_satellites_and_fixes_come_from_the_files(folder):
    """The fixes lie at the surveyed place; times are UTC on the IMU's clock: its last sample is taken 118.98 s after noon, the
    last epoch with a rate is the one before 12:01:59. The first epoch makes the start and is not used again, by either."""
    log = import_log("rinex", folder, **SENSORS).log
    assert log.imu.t[-1] - log.gnss.t[-1] == pytest.approx(118.98 - 118.0, abs=1e-6)
    assert len(np.unique(log.gnss_raw.t)) == len(log.gnss.t) == 117 and len(log.gnss_raw.satellites()) > 12
    off = np.array(earth.position_difference(log.gnss.lat, log.gnss.lon, log.gnss.h, *PLACE))
    assert np.hypot(off[0], off[1]).max() < 2.0 and np.abs(off[2]).max() < 3.0
    moved = import_log("rinex", folder, gnss={"clock_s": 2.0, "lever_arm_m": [1.0, 2.0, 3.0]}, **SENSORS).log
    assert moved.gnss_raw.t[0] - log.gnss_raw.t[0] == pytest.approx(2.0, abs=1e-6)
    assert moved.gnss_raw.spec.lever_arm_b == moved.gnss.spec.lever_arm_b == (1.0, 2.0, 3.0)


def test_a_tightly_coupled_filter_runs_on_them(folder):
    """Within 3 m of the surveyed place (the fixes' own mean error is 1.6 m), and no worse than its sigma says: the errors of
    this sky, which no file states, are no larger than those that the filter takes for a quiet day's. But for G28: its range is 3 m
    off in the receiver's fixes and in sidereon's, where no other's is more than 1.2 m. A filter that estimates what lasts has
    ranges good enough to refuse it, and no other; one that only counts it has not."""
    log = import_log("rinex", folder, **SENSORS).log
    raw, wrong = log.gnss_raw, 128
    residual = np.array([np.mean(raw.residual[raw.sv == sv]) for sv in np.unique(raw.sv)])
    assert np.unique(raw.sv)[np.abs(residual) > 1.2].tolist() == [wrong]
    for slow in ("states", "consider"):
        solution = make_estimator("tight-kf", slow_errors=slow).run(log)
        off = np.array([x[-1] for x in earth.position_difference(solution.lat, solution.lon, solution.h, *PLACE)])
        assert np.linalg.norm(off) < 3.0 and (np.abs(off) < 3.0 * solution.std[-1, :3]).all(), slow
        nu = solution.innovations["pseudorange"]
        used = raw.sv[raw.t <= nu.t[-1] + 1e-6]
        assert (solution.std[-1, :3] > 0.3).all() and len(used) == len(nu.t)
        assert set(used[nu.rejected]) == ({wrong} if slow == "states" else set()), slow


def test_what_is_withheld_is_withheld_from_both(folder):
    recording = import_log("rinex", folder, **SENSORS)
    window = (recording.log.initial.t + 40.0, recording.log.initial.t + 60.0)
    kept = withhold(recording.log, (window,))
    for samples in (kept.gnss, kept.gnss_raw):
        assert not ((samples.t > window[0]) & (samples.t <= window[1])).any() and (samples.t > window[1]).any()


def test_only_the_part_that_is_wanted(folder):
    whole = import_log("rinex", folder, **SENSORS).log
    log = import_log("rinex", folder, end_s=float(whole.imu.t[3000]), **SENSORS).log
    assert log.gnss_raw.t[-1] <= whole.imu.t[3000] + 1e-9 < whole.gnss_raw.t[-1]


def test_mistakes_are_told(folder, tmp_path):
    (tmp_path / "imu.csv").write_bytes((folder / "imu.csv").read_bytes())
    with pytest.raises(InputError, match=r"holds 0 files of the part .obs.; name the one to use under files\.obs"):
        import_log("rinex", tmp_path, **SENSORS)
    (tmp_path / "site.21O").write_bytes((folder / "site.21O").read_bytes())
    other = (DATA / "SEPT2650.21P").read_bytes()
    (tmp_path / "other.21P").write_bytes(other)
    with pytest.raises(InputError, match=r"site\.21O: no pseudorange of a satellite with an ephemeris in .*other\.21P"):
        import_log("rinex", tmp_path, **SENSORS)
