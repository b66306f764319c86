"""Cost of the strapdown and of the indirect filter per sample, beside the arithmetic that they cannot do without and peers.

Run with ``make bench``. 20,000 samples at 200 Hz with 5 Hz fixes (peers: fewer, their cost is linear in them); timings are
printed, never asserted. The plain loop must agree with the strapdown, or its time would say nothing.
"""

from __future__ import annotations

import numpy as np
import pytest

from estimators.methods.eskf import Eskf
from estimators.methods.indirect_kf import IndirectKf
from estimators.methods.ins import Ins
from testbed.data.records import BaroSamples, GnssFixes, ImuSamples, InitialState, NavSolution, SensorLog, Trajectory
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, TriadSpec
from testbed.physics.rotations import euler_to_quat
from tests.benchmarks.arithmetic import strapdown_steps, triple_products
from tests.benchmarks.python_peers import free_integration

SAMPLES, RATE_HZ = 20_000, 200.0
BIASES = ["accel-bias", "gyro-bias"]
PARTS = {
    "21": ([*BIASES, "accel-scale", "gyro-scale", "baro-bias"], ["gnss", "baro"]),
    "42": (
        [*BIASES, "accel-scale", "gyro-scale", "accel-misalignment", "gyro-misalignment", "g-sensitivity"],
        ["gnss"],
    ),
}
"""States and aiding of compositions, by the number of states (the first has a barometer's bias as well)."""


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


def shortened(log: SensorLog, samples: int) -> SensorLog:
    """The first samples of a log."""
    imu, gnss = log.imu, log.gnss
    assert gnss is not None
    keep = gnss.t < imu.t[samples - 1]
    fixes = GnssFixes(gnss.t[keep], gnss.lat[keep], gnss.lon[keep], gnss.h[keep], gnss.v_n[keep], gnss.spec)
    return SensorLog(ImuSamples(imu.t[:samples], imu.gyro[:samples], imu.accel[:samples], imu.spec), log.initial, fixes)


@pytest.mark.benchmark(group="strapdown, 200 Hz")
class TestStrapdown:
    def test_bench_strapdown_arithmetic(self, benchmark, log):
        benchmark.extra_info["samples"] = SAMPLES
        benchmark(strapdown_steps, log.imu.gyro, log.imu.accel, 1.0 / RATE_HZ)

    def test_bench_strapdown(self, benchmark, log):
        benchmark.extra_info["samples"] = SAMPLES
        benchmark(Ins().run, log)

    def test_bench_strapdown_python_ins(self, benchmark, log):
        pytest.importorskip("pyins")
        from pyins.strapdown import Integrator

        from estimators.peers.pyins_peer import imu_increments, initial_pva

        pva, increments = initial_pva(log), imu_increments(log)
        benchmark.extra_info["samples"] = SAMPLES
        benchmark.pedantic(lambda: Integrator(pva).integrate(increments), rounds=5)

    def test_bench_strapdown_plain_python(self, benchmark, log):
        short = shortened(log, SAMPLES // 10)
        benchmark.extra_info["samples"] = SAMPLES // 10
        places, velocities = benchmark.pedantic(free_integration, (short,), rounds=3)
        ours = Ins().run(short)
        # 10 s at rest: first order and gravity by another formula differ by less than a millimetre per second
        assert np.abs(velocities - ours.v_n).max() < 1e-2
        assert np.abs(places[:, 2] - ours.h).max() < 0.1


@pytest.mark.benchmark(group="indirect filter, 200 Hz")
class TestIndirect:
    def test_bench_triple_product(self, benchmark):
        phi = np.eye(15) + 1e-6
        benchmark.extra_info["samples"] = SAMPLES
        benchmark(triple_products, phi, np.eye(15), SAMPLES)

    def test_bench_indirect_kf(self, benchmark, log):
        benchmark.extra_info["samples"] = SAMPLES
        benchmark(IndirectKf().run, log)

    @pytest.mark.parametrize("name", PARTS)
    def test_bench_composed(self, benchmark, log, name):
        """With a height at 10 Hz where it has one."""
        states, aiding = PARTS[name]
        composed = Eskf(states=states, aiding=aiding)
        t = np.arange(0.1, log.imu.t[-1], 0.1)
        heights = BaroSamples(
            t,
            np.full(len(t), 101325.0 * (1.0 - 2.25577e-5 * 100.0) ** 5.25588),
            BaroSpec("bench", 10.0, 5.0, 30.0, 0.1),
        )
        benchmark.extra_info["samples"] = SAMPLES
        benchmark(composed.run, SensorLog(log.imu, log.initial, log.gnss, baro=heights) if "baro" in aiding else log)

    def test_bench_filter_search(self, benchmark, log):
        """One candidate of a search, scored against a reference."""
        s: NavSolution = IndirectKf().run(log)
        truth = Trajectory(s.t, s.lat, s.lon, s.h, s.v_n, s.q_nb, log.imu.accel, log.imu.gyro)
        benchmark.extra_info["samples"] = SAMPLES
        benchmark(IndirectKf.searcher(log, truth), IndirectKf())

    def test_bench_python_ins(self, benchmark, log):
        """The peer propagates its covariance at 10 Hz only."""
        pytest.importorskip("pyins")
        from estimators.peers.pyins_peer import PyIns

        benchmark.extra_info["samples"] = SAMPLES // 10
        benchmark.pedantic(PyIns().run, (shortened(log, SAMPLES // 10),), rounds=3)
