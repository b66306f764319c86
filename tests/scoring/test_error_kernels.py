"""The compiled pass over a solution: its errors are those of their definitions, its statistics those of numpy on any rows."""

from __future__ import annotations

import numpy as np
import pytest

from testbed.physics import earth, rotations
from testbed.scenario.windows import Window
from testbed.scoring import error_kernels, metrics
from testbed.scoring.error_kernels import Motion
from testbed.scoring.error_series import ErrorSeries
from testbed.scoring.quantities import AXES, QUANTITIES, STATISTICS

N = 1000


@pytest.fixture(scope="module")
def motions() -> tuple[Motion, Motion]:
    """Truth and estimate: any attitude, errors of any size, the date line between some pairs of longitudes."""
    rng = np.random.default_rng(3)
    q = rng.normal(size=(N, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    angle = 10.0 ** rng.uniform(-9.0, 0.5, N)
    axis = rng.normal(size=(N, 3))
    axis *= (angle / np.linalg.norm(axis, axis=1))[:, None]
    own = np.array(
        [rotations.quat_multiply(rotations.rotvec_to_quat(a), b) for a, b in zip(axis, q, strict=True)]
    ) * rng.choice([-1.0, 1.0], (N, 1))
    lat, lon, h = rng.uniform(-1.4, 1.4, N), rng.uniform(-np.pi, np.pi, N), rng.uniform(-100.0, 1e4, N)
    lon[::7] = np.pi - 1e-7
    size = 10.0 ** rng.uniform(-8.0, -4.0, (3, N))
    v = rng.normal(scale=100.0, size=(N, 3))
    place = lat + size[0], rotations.wrap(lon + 3e-7 + size[1]), h + 1e6 * size[2]
    return Motion(lat, lon, h, v, q), Motion(*place, v + rng.normal(size=(N, 3)), own)


def series(motions) -> ErrorSeries:
    truth, estimate = motions
    return ErrorSeries(np.arange(N) * 0.1, estimate, truth)


def test_the_errors_are_those_of_their_definitions(motions):
    """The definitions are whole-log functions of `earth` and `rotations`; what differs is rounding.

    An Euler angle's difference of two angles of up to pi is rounded to 2e-16 pi, in degrees 5e-14, three times.
    """
    truth, estimate = motions
    values, phi = error_kernels.error_rows(truth, estimate)
    places = earth.position_difference(*estimate[:3], *truth[:3])
    assert np.array_equal(values[:, :3], np.column_stack(places))
    assert np.array_equal(values[:, 3:6], estimate.v_n - truth.v_n)
    euler = rotations.wrap(rotations.quats_to_eulers(estimate.q_nb) - rotations.quats_to_eulers(truth.q_nb))
    turned = rotations.wrap(np.radians(values[:, 6:]) - euler)  # +180 and -180 are one
    level = np.abs(np.cos(rotations.quats_to_eulers(truth.q_nb)[:, 1]))  # roll and yaw are worth that many digits
    assert (np.abs(turned).max(axis=1) < 2e-15 / np.minimum(level, 0.5)).all()
    exact = rotations.attitude_errors(estimate.q_nb, truth.q_nb)
    assert np.linalg.norm(phi - exact, axis=1) == pytest.approx(0.0, abs=2e-15)


def test_latitudes_that_are_close_have_the_radii_of_the_earth(motions):
    """A block of one place takes sine and cosine from its first row's: a few roundings of a part in 2e-16."""
    truth, estimate = motions
    lat = 0.9 + np.cumsum(np.full(N, 1e-5))
    truth, estimate = truth._replace(lat=lat), estimate._replace(lat=lat + 1e-5)
    values, _ = error_kernels.error_rows(truth, estimate)
    wanted = np.column_stack(earth.position_difference(*estimate[:3], *truth[:3]))
    assert values[:, :3] == pytest.approx(wanted, rel=2e-15, abs=0.0)


@pytest.mark.parametrize("size", [1, 3, 15])
def test_quadratic_forms_are_those_of_the_solution(size):
    """Against LAPACK: condition 1e3 at most, so a part in 1e12 is a thousand roundings. Any rows of any snapshots; a singular one."""
    rng = np.random.default_rng(size)
    half = rng.normal(size=(8, size + 2, size + 2))
    covariance = half @ half.transpose(0, 2, 1) + 0.1 * np.eye(size + 2)
    rows, at = rng.permutation(size + 2)[:size], np.array([7, 0, 3, 3])
    error = rng.normal(size=(4, size))
    block = covariance[at][:, rows[:, None], rows]
    wanted = [e @ np.linalg.solve(p, e) for e, p in zip(error, block, strict=True)]
    assert error_kernels.quadratic_forms(error, covariance, at, rows) == pytest.approx(wanted, rel=1e-12)
    covariance[3] = 0.0
    found = error_kernels.quadratic_forms(error, covariance, at, rows)
    assert np.isfinite(found[:2]).all() and (found[2:] == np.inf).all()


def test_every_quantity_is_the_registrys(motions):
    """The compiled columns stand in the order of `QUANTITIES`, and each is what its entry says of errors and rotation vector."""
    made = series(motions)
    assert len(QUANTITIES) == error_kernels.COLUMNS
    assert [list(QUANTITIES)[k] for k in error_kernels.AXES] == list(AXES)
    for k, quantity in enumerate(QUANTITIES.values()):
        wanted = quantity.of(made.values, made.phi)
        found = np.array([made.statistics([(r, r + 1)])[2, k] for r in range(0, N, 50)])
        assert found == pytest.approx(np.abs(wanted[::50]), rel=1e-12, abs=1e-13), quantity.name


@pytest.mark.parametrize(
    "spans", [[(0, N)], [(0, 1)], [(5, 7), (100, 900)], [(128, 256)], [(127, 129), (127, 129)], [(640, N), (999, N)]]
)
def test_statistics_of_any_rows_are_numpys(motions, spans):
    """Sums of blocks and of single rows: another order than numpy's, which a thousand terms round to 1e-13."""
    made = series(motions)
    columns = np.column_stack([q.of(made.values, made.phi) for q in QUANTITIES.values()])
    rows = np.concatenate([columns[a:b] for a, b in spans])
    ends = np.array([columns[b - 1] for _, b in spans])
    wanted = [np.sqrt((rows**2).mean(axis=0)), np.abs(rows).max(axis=0), np.sqrt((ends**2).mean(axis=0))]
    found = made.statistics(spans)
    assert found[:3] == pytest.approx(np.array(wanted), rel=1e-12, abs=1e-13)
    assert found[3] == pytest.approx(rows.mean(axis=0), rel=1e-12, abs=1e-13 * np.abs(rows).max())


def test_the_arctangent_is_the_librarys():
    """All octants, signs and sizes, on the axes and at the diagonal, to 1e-15 of the angle; NaN stays."""
    rng = np.random.default_rng(4)
    y, x = rng.choice([-1.0, 1.0], (2, 20_000)) * 10.0 ** rng.uniform(-20.0, 20.0, (2, 20_000))
    y, x = np.r_[y, 0.0, 0.0, 1.0, -1.0, 2.0, -3.0], np.r_[x, 1.0, -1.0, 0.0, 0.0, 2.0, -3.0]
    found = np.array([error_kernels.arctan2(*pair) for pair in zip(y, x, strict=True)])
    assert found == pytest.approx(np.arctan2(y, x), rel=1e-15, abs=0.0)
    assert error_kernels.arctan2(0.0, 0.0) == 0.0
    assert np.isnan(error_kernels.arctan2(np.nan, 1.0)) and np.isnan(error_kernels.arctan2(1.0, np.nan))


def test_a_row_that_is_not_finite_spoils_its_own_windows_only(motions):
    truth, estimate = motions
    broken = estimate._replace(lat=estimate.lat.copy(), q_nb=estimate.q_nb.copy())
    broken.lat[300], broken.q_nb[301] = np.nan, np.nan
    made = series((truth, broken))
    assert np.isfinite(made.statistics([(0, 300), (302, N)])).all()
    spoilt = made.statistics([(250, 400)])
    north, yaw, velocity = (list(QUANTITIES).index(name) for name in ("north_m", "yaw_deg", "velocity_3d_mps"))
    assert np.isnan(spoilt[[0, 1, 3]][:, [north, yaw]]).all() and np.isfinite(spoilt[:, velocity]).all()
    assert not made.stays_within(1e9)
    assert metrics.divergence(made, 1e9) == "not finite from 30 s"


def test_the_poles_keep_the_convention():
    """At a pitch of 90 degrees roll and yaw are one turn, which `rotations.quat_to_euler` gives to yaw, in both attitudes."""
    n = 300
    flat = np.zeros(n)
    half = np.sqrt(0.5)
    q = np.tile(rotations.euler_to_quat(0.3, -0.2, 1.0), (n, 1))
    q[200:] = np.array([half, 0.0, half, 0.0])
    own = q.copy()
    own[:] = [rotations.quat_multiply(rotations.rotvec_to_quat((0.0, 0.0, 0.01)), row) for row in q]
    motion = Motion(flat + 0.8, flat, flat, np.zeros((n, 3)), q)
    values, _ = error_kernels.error_rows(motion, motion._replace(q_nb=own))
    assert values[:, 8] == pytest.approx(np.degrees(0.01), rel=1e-9)
    assert values[:, 6:8] == pytest.approx(0.0, abs=1e-9)


def test_the_rows_of_a_table_are_the_statistics_by_name(motions):
    made = series(motions)
    rows = metrics.score_rows(made, {}, [Window("all", ((-1.0, 1e3),)), Window("none", ((2e3, 3e3),))])
    names = [f"{statistic}_{quantity}" for statistic in STATISTICS for quantity in QUANTITIES]
    assert [(window, metric) for window, metric, _ in rows] == [("all", name) for name in names]
    assert [value for *_, value in rows] == made.statistics([(0, N)]).ravel().tolist()
