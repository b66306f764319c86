"""Other projects' loosely coupled filters on the flight of `test_bench_direct`: INSLIB (C, in a process of its own) and sidereon (Rust).

Printed, never asserted, but that each follows the flight: metres per second within a few of its own sigmas.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from testbed.physics.ecef import directions, to_ecef
from testbed.physics.rotations import quat_to_euler, quat_to_matrix
from tests.synthetic import sensor_log, weaving_flight

GROUP = "direct filters, 100 Hz"
SAMPLES = 3000
POSITION_SIGMA, VELOCITY_SIGMA = 3.0, 0.1
ACCEL_NOISE, GYRO_NOISE = 0.02, 2e-4
"""Per sample: the defaults of `sensor_log`."""
LARGEST_ERROR = 0.3
"""Of a final velocity, m/s: three sigmas of one fix."""


@pytest.fixture(scope="module")
def flown():
    truth = weaving_flight(150.0)
    log = sensor_log(truth, 1, gnss_rate=5.0, position_sigma=POSITION_SIGMA, velocity_sigma=VELOCITY_SIGMA)
    return truth, log


@pytest.mark.benchmark(group=GROUP)
@pytest.mark.skipif(find_spec("INSLIB") is None, reason="needs the extra 'oracles' (INSLIB)")
def test_bench_inslib(benchmark, flown, tmp_path) -> None:
    truth, log = flown
    gnss = log.gnss
    np.savez(
        tmp_path / "log.npz",
        t=log.imu.t,
        t_start=log.initial.t,
        gyro=log.imu.gyro,
        accel=log.imu.accel,
        t_fix=gnss.t,
        lla=np.column_stack([gnss.lat, gnss.lon, gnss.h]),
        v_n=gnss.v_n,
        rpy=quat_to_euler(log.initial.q_nb),
        accel_density=ACCEL_NOISE**2 * truth.dt,
        gyro_density=GYRO_NOISE**2 * truth.dt,
        fix_variance=POSITION_SIGMA**2,
        velocity_variance=VELOCITY_SIGMA**2,
    )
    script = Path(__file__).with_name("inslib_process.py")

    def run():
        done = subprocess.run([sys.executable, script, tmp_path / "log.npz"], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    found = benchmark.pedantic(run, rounds=1)
    benchmark.extra_info["us_per_sample"] = found["us_per_sample"]
    assert np.abs(truth.v_n[-1] - found["v_n"]).max() < LARGEST_ERROR


@pytest.mark.benchmark(group=GROUP)
def test_bench_sidereon(benchmark, flown) -> None:
    """On a part of the flight: its cost is linear in the samples."""
    sidereon = pytest.importorskip("sidereon")
    truth, log = flown
    gnss, start = log.gnss, log.initial
    c_en = np.swapaxes(directions(gnss.lat, gnss.lon), 1, 2)
    places, speeds = to_ecef(gnss.lat, gnss.lon, gnss.h), np.einsum("kij,kj->ki", c_en, gnss.v_n)
    first = directions(np.array([start.lat]), np.array([start.lon]))[0].T
    due = np.searchsorted(log.imu.t, gnss.t - 1e-6)
    covariance = np.diag(np.repeat([POSITION_SIGMA, VELOCITY_SIGMA], 3) ** 2)
    root = np.sqrt(truth.dt)
    # the log has no bias: the least that the filter takes
    spec = sidereon.ImuSpec(ACCEL_NOISE * root, GYRO_NOISE * root, 1e-4, 1e-6, 1e3, 1e3)

    def run():
        begin = to_ecef(*np.array([[start.lat], [start.lon], [start.h]]))[0]
        attitude = first @ np.array(quat_to_matrix(start.q_nb))
        state = sidereon.NavState(start.t, begin, first @ start.v_n, attitude)
        variances = [*(start.std[:9] ** 2), *[1e-8] * 3, *[1e-12] * 3]
        filtered = sidereon.InsFilterState.from_diagonal(state, sidereon.ErrorStateLayout.FIFTEEN, variances)
        kind = sidereon.FusionFilterKind.EKF
        ekf = sidereon.InertialFilter.with_config(filtered, sidereon.InertialFilterConfig(spec, kind))
        fix = 0
        for k in range(SAMPLES):
            ekf.propagate(sidereon.ImuSample.rate(log.imu.t[k], log.imu.accel[k], log.imu.gyro[k]))
            if fix < len(due) and k == due[fix]:
                taken = sidereon.GnssFixMeasurement.position_velocity(
                    log.imu.t[k], places[fix], speeds[fix], covariance, 9
                )
                ekf.update_loose(taken)
                fix += 1
        return ekf.state.nominal.velocity_ecef_mps

    benchmark.extra_info["samples"] = SAMPLES
    found = benchmark.pedantic(run, rounds=1, warmup_rounds=0)
    at = truth.t.searchsorted(log.imu.t[SAMPLES - 1] - 1e-6)
    c_ne = directions(truth.lat[[at]], truth.lon[[at]])[0]
    assert np.abs(truth.v_n[at] - c_ne @ found).max() < LARGEST_ERROR
