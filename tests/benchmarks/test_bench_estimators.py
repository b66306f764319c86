"""Cost of the strapdown and of the indirect filter per sample, beside the triple product that it cannot do without.

Run with ``make bench``. 20,000 samples at 200 Hz with 5 Hz fixes; timings are printed, never asserted.
"""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from estimators.indirect_kf import IndirectKf
from estimators.ins import Ins
from testbed.records import GnssFixes, ImuSamples, InitialState, NavSolution, SensorLog, Trajectory
from testbed.rotations import euler_to_quat
from testbed.specs import GnssSpec, ImuSpec, TriadSpec

SAMPLES, RATE_HZ = 20_000, 200.0


@njit
def triple_products(phi, p, n):
    for _ in range(n):
        p = phi @ p @ phi.T
    return p


@pytest.fixture(scope="module")
def log() -> SensorLog:
    rng = np.random.default_rng(0)
    t = np.arange(1, SAMPLES + 1) / RATE_HZ
    gyro, accel = 0.002 * rng.standard_normal((SAMPLES, 3)), 0.02 * rng.standard_normal((SAMPLES, 3)) - [0.0, 0.0, 9.8]
    triads = TriadSpec(1e-3, None, 1e-4, 100.0, 1e-4), TriadSpec(1e-2, None, 1e-3, 100.0, 1e-3)
    zero, std = np.zeros(3), np.repeat([2.0, 0.1, 0.02, 0.01, 0.001], 3)
    start = InitialState(0.0, 0.8, 0.1, 100.0, zero, np.array(euler_to_quat(0.0, 0.0, 0.0)), zero, zero, std)
    fixes = np.arange(0.2, t[-1], 0.2)
    place = [np.full(len(fixes), x) for x in (0.8, 0.1, 100.0)]
    spec = GnssSpec("bench", 5.0, 2.0, 4.0, velocity_sigma=0.1, lever_arm_b=(0.5, 0.0, -1.0))
    gnss = GnssFixes(fixes, *place, np.zeros((len(fixes), 3)), spec)
    return SensorLog(ImuSamples(t, gyro, accel, ImuSpec("bench", RATE_HZ, *triads)), start, gnss)


def per_sample(benchmark, samples: int = SAMPLES) -> None:
    if benchmark.stats is not None:
        benchmark.extra_info["us_per_sample"] = 1e6 * benchmark.stats["min"] / samples


def test_bench_triple_product(benchmark):
    phi = np.eye(15) + 1e-6
    benchmark(triple_products, phi, np.eye(15), SAMPLES)
    per_sample(benchmark)


def test_bench_strapdown(benchmark, log):
    benchmark(Ins().run, log)
    per_sample(benchmark)


def test_bench_indirect_kf(benchmark, log):
    benchmark(IndirectKf().run, log)
    per_sample(benchmark)


def test_bench_filter_search(benchmark, log):
    """One candidate of a search, scored against a reference."""
    s: NavSolution = IndirectKf().run(log)
    truth = Trajectory(s.t, s.lat, s.lon, s.h, s.v_n, s.q_nb, log.imu.accel, log.imu.gyro)
    benchmark(IndirectKf.searcher(log, truth), IndirectKf())
    per_sample(benchmark)


def test_bench_python_ins(benchmark, log):
    """The peer, on a tenth of the samples: its cost is linear in them."""
    pytest.importorskip("pyins")
    from estimators.pyins_peer import PyIns

    n = SAMPLES // 10
    imu, gnss = log.imu, log.gnss
    assert gnss is not None
    keep = gnss.t < imu.t[n - 1]
    fixes = GnssFixes(gnss.t[keep], gnss.lat[keep], gnss.lon[keep], gnss.h[keep], gnss.v_n[keep], gnss.spec)
    short = SensorLog(ImuSamples(imu.t[:n], imu.gyro[:n], imu.accel[:n], imu.spec), log.initial, fixes)
    benchmark.pedantic(PyIns().run, (short,), rounds=2)
    per_sample(benchmark, n)
