"""The covariance of a fix: as the receiver states it, and as a loosely coupled filter uses it."""

import numpy as np
import pytest
from outages import errors_of, record
from test_receiver import white_epochs

from estimators.methods.indirect_kf import IndirectKf
from estimators.methods.tight_kf import TightKf
from testbed.data.records import SensorLog
from testbed.gnss.receiver import solve
from testbed.physics import earth


def test_the_stated_correlations_are_those_of_the_errors():
    """White errors of eleven satellites: correlations of 20,000 fixes, whose own deviation is 0.007, four times that."""
    received, _ = white_epochs(20_000, 3)
    fixes = solve(received, 0.0)
    off = np.column_stack(earth.position_difference(*fixes.place.T, 0.8, 0.2, 100.0))
    found, pairs = np.corrcoef(off.T), [(0, 1), (0, 2), (1, 2)]
    assert fixes.correlation[0, :3] == pytest.approx([found[i, j] for i, j in pairs], abs=0.03)
    assert np.abs(fixes.correlation[0, :3]).max() > 0.1
    # rates have the same geometry and equal weights
    assert fixes.correlation[0, 3:] == pytest.approx(fixes.correlation[0, :3], abs=1e-4)


def test_a_filter_uses_the_whole_covariance():
    """One fix of a vehicle at a known start: position and velocity of the filter are the matrix update with the covariance
    that the receiver states, which sequential scalars of the variances alone would miss by centimetres; innovations are told
    along north, east, down."""
    log, _, _ = record(4, 20.0, lever_arm_m=[0.0, 0.0, 0.0])
    f = IndirectKf().start(log)
    event = next(found for k in range(len(log.imu.t)) if (found := f.predict(k)) is not None)
    before = f.P[:6, :6].copy()
    nu, s = f.innovation(*event)
    std, c = log.gnss.std[0], log.gnss.correlation[0]
    r = np.diag(std**2)
    for first in (0, 3):
        for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            i, j = first + i, first + j
            r[i, j] = r[j, i] = c[first + k] * std[i] * std[j]
    assert np.allclose(s, before + r, rtol=1e-9, atol=1e-12) and np.abs(c[:3]).max() > 0.1
    assert f.R(*event) == pytest.approx(std**2)
    height = f.state.h
    f.update(*event)
    gain = before @ np.linalg.inv(before + r)
    x = gain @ nu
    assert height - f.state.h == pytest.approx(x[2], abs=1e-9)
    assert np.allclose(f.P[:3, :3], (before - gain @ before)[:3, :3], rtol=1e-7, atol=1e-12)
    alone = before @ np.linalg.inv(before + np.diag(std**2)) @ nu
    assert np.abs(alone[:3] - x[:3]).max() > 0.02


def test_loose_and_tight_are_the_same_filter_on_white_errors():
    """Of a fix with its whole covariance a loosely coupled filter learns what the satellites tell of place and velocity; the
    tight one has the clock's own dynamics besides, and a rate that follows the line of sight. The sigmas say how much that is
    worth: with the deviations alone the loosely coupled filter states another height."""
    log, truth, _ = record(2, 30.0)
    fixes = log.gnss
    loose, tight = IndirectKf().run(log), TightKf(slow_errors="white", gate=False).run(log)
    apart = np.abs(errors_of(loose, truth) - errors_of(tight, truth))[1000:].mean()
    bare = type(fixes)(**{**vars(fixes), "correlation": None})
    alone = IndirectKf().run(SensorLog(log.imu, log.initial, bare))
    assert apart < np.abs(errors_of(alone, truth) - errors_of(tight, truth))[1000:].mean()


def test_correlations_are_stored_and_chosen(tmp_path):
    log, _, _ = record(1, 12.0)
    log.save(tmp_path / "log")
    back = SensorLog.load(tmp_path / "log").gnss
    assert np.array_equal(back.correlation, log.gnss.correlation)
    part = log.gnss.taken(slice(3, 9))
    assert np.array_equal(part.correlation, log.gnss.correlation[3:9]) and len(part.t) == 6
