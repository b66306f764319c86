"""Plug-in for the tests of the runner: a short synthetic flight in place of JSBSim, and estimators that behave or do not.

Loading it replaces `pipeline.fly` and `pipeline.sense`, in the workers too: straight and level at 50 m/s north, 10 Hz.
An estimator is the truth plus noise that is drawn per run, so what the statistics must find is known.
"""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from testbed import pipeline
from testbed.base.streams import stream
from testbed.data.records import (
    STATE_NAMES,
    GnssFixes,
    ImuSamples,
    InitialState,
    Innovations,
    NavSolution,
    SensorErrors,
    SensorLog,
    Trajectory,
)
from testbed.physics import earth

DURATION_S, RATE_HZ, SPEED_MPS = 60.0, 10.0, 50.0


def synthetic_flight(*_args, **_kwargs):
    t = np.arange(0.0, DURATION_S + 1e-9, 1.0 / RATE_HZ)
    n, zero = len(t), np.zeros(len(t))
    lat = 0.8 + SPEED_MPS * t / earth.metres_per_radian(0.8, 100.0)[0]
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    down = np.tile([0.0, 0.0, -9.8], (n, 1))
    return Trajectory(
        t, lat, zero + 0.1, zero + 100.0, np.tile([SPEED_MPS, 0.0, 0.0], (n, 1)), q, down, np.zeros((n, 3))
    )


def synthetic_log(scenario, trajectory, seed=None, run=0):
    seed = scenario.monte_carlo.seed if seed is None else seed
    t, zero = trajectory.t[1:], np.zeros((len(trajectory.t) - 1, 3))
    start = (float(getattr(trajectory, k)[0]) for k in ("lat", "lon", "h"))
    initial = InitialState(0.0, *start, trajectory.v_n[0], trajectory.q_nb[0], np.zeros(3), np.zeros(3), np.ones(15))
    fix = np.arange(10, len(trajectory.t), 10)
    gnss = GnssFixes(*(getattr(trajectory, k)[fix] for k in ("t", "lat", "lon", "h", "v_n")), outages=((20.0, 30.0),))
    log = SensorLog(ImuSamples(t, zero, zero), initial, gnss, name=f"{seed} {run}")
    return log, SensorErrors(t, zero, zero)


pipeline.fly, pipeline.sense = synthetic_flight, synthetic_log


def run_of(log):
    return int(log.name.split()[1])


def _truth_plus(log, name, sigma_m, common=0.0):
    """Truth displaced north by a constant drawn per run: |N(0, sigma_m)| + common part shared by all estimators."""
    seed, run = map(int, log.name.split())
    truth = synthetic_flight()
    shift = stream(seed, run, name).normal(scale=sigma_m) + common * stream(seed, run, "common").normal()
    per_radian = earth.metres_per_radian(truth.lat, truth.h)[0]
    k = slice(1, None)
    n = len(truth.t) - 1
    snapshots = np.arange(9, n, 10)
    covariance = np.tile(np.diag([sigma_m**2 + common**2] + [1.0] * 14), (len(snapshots), 1, 1))
    std = np.tile(np.sqrt(np.diag(covariance[0])), (n, 1))
    rng = stream(seed, run, name + " innovations")
    nu = Innovations(
        truth.t[k][snapshots], rng.normal(size=(len(snapshots), 2)), np.tile(np.eye(2), (len(snapshots), 1, 1))
    )
    return NavSolution(
        *(truth.t[k], (truth.lat + shift / per_radian)[k], truth.lon[k], truth.h[k], truth.v_n[k], truth.q_nb[k]),
        *(np.zeros((n, 3)), np.zeros((n, 3)), std, truth.t[k][snapshots], covariance, nu),
        states=STATE_NAMES,
    )


@dataclass(frozen=True)
class Noisy:
    """Truth plus a constant offset per run."""

    sigma_m: float = 1.0
    common_m: float = 0.0
    stream_name: str = "noisy"
    delay_s: float = 0.0
    name = "noisy"

    def run(self, log):
        time.sleep(self.delay_s)
        return _truth_plus(log, self.stream_name, self.sigma_m, self.common_m)


@dataclass(frozen=True)
class Raises:
    """Raises in every tenth run."""

    name = "raises"

    def run(self, log):
        if run_of(log) % 10 == 3:
            raise ValueError("as told")
        return _truth_plus(log, "raises", 1.0)


@dataclass(frozen=True)
class NotANumber:
    """NaN from the middle on, in every fifth run."""

    name = "nan"

    def run(self, log):
        solution = _truth_plus(log, "nan", 1.0)
        if run_of(log) % 5 == 1:
            solution.lat[300:] = np.nan
        return solution


@dataclass(frozen=True)
class Hangs:
    """Sleeps in run 1; with ``deaf`` it also ignores the alarm, as native code does."""

    deaf: bool = False
    name = "hangs"

    def run(self, log):
        if run_of(log) == 1:
            if self.deaf:
                signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
            while True:
                try:
                    time.sleep(60.0)
                except Exception:
                    continue
        return _truth_plus(log, "hangs", 1.0)


@dataclass(frozen=True)
class Kills:
    """Ends its own process in run ``at``: always, or only as long as the file ``marker`` is absent."""

    marker: str = ""
    at: int = 2
    name = "kills"

    def run(self, log):
        if run_of(log) == self.at and not (self.marker and Path(self.marker).exists()):
            if self.marker:
                Path(self.marker).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return _truth_plus(log, "kills", 1.0)


@dataclass(frozen=True)
class Interrupted:
    """Ctrl-C in run ``at`` while a compiled loop runs, which numba turns into a SystemError."""

    at: int = 2
    name = "interrupted"

    def run(self, log):
        if run_of(log) == self.at:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as pressed:
                raise SystemError("returned a result with an exception set") from pressed
        return _truth_plus(log, "interrupted", 1.0)


@dataclass(frozen=True)
class Still:
    """The same error in every run, as on a recording."""

    north_m: float = 1.0
    name = "still"

    def run(self, log):
        truth = synthetic_flight()
        k, n = slice(1, None), len(truth.t) - 1
        shift = self.north_m / earth.metres_per_radian(truth.lat, truth.h)[0]
        return NavSolution(
            truth.t[k],
            (truth.lat + shift)[k],
            truth.lon[k],
            truth.h[k],
            truth.v_n[k],
            truth.q_nb[k],
            *(np.zeros((2, n, 3))),
        )


@dataclass(frozen=True)
class Repeats:
    """Noise that is that of run 4 from there on."""

    sigma_m: float = 1.0
    name = "repeats"

    def run(self, log):
        seed, run = map(int, log.name.split())
        same = SensorLog(log.imu, log.initial, log.gnss, name=f"{seed} {min(run, 4)}")
        return _truth_plus(same, f"repeats {self.sigma_m}", self.sigma_m)


@dataclass(frozen=True)
class Spoils:
    """Writes into the log that it is handed."""

    name = "spoils"

    def run(self, log):
        log.imu.accel[:] = 1e3
        log.gnss.lat[:] = 0.0
        return _truth_plus(log, "spoils", 1.0)


@dataclass(frozen=True)
class Reads:
    """Errs by what it reads, which is nought where nobody wrote there."""

    name = "reads"

    def run(self, log):
        return _truth_plus(log, "reads", 1e-6 + np.abs(log.imu.accel).max())
