"""Where a vehicle stands, as its IMU feels it: a likelihood-ratio test of windows of samples.

Skog, Händel, Nilsson & Rantakokko, *IEEE Trans. Biomedical Engineering* 57 (2010): the samples of a window are noise
about a constant, and so are those of the window before. Means are compared with gravity and no turn as far as the biases
are known. SI units.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.aiding import Array
from estimators.policies import fraction
from testbed.data.records import SensorLog
from testbed.data.specs import TriadSpec
from testbed.physics import earth

SIGMAS = 4.0
"""Of what biases and noise make of a window's mean: one stop in some thousand is missed."""
DITHERED = 1.0 / 3.0
"""Noise variance in LSB² from which rounding is white and part of the data sheet's noise."""


def stops(log: SensorLog, window_s: float, pass_rate: float) -> Array:
    """Ends (s) of the windows of ``window_s`` in which the vehicle stands; a standing one passes with ``pass_rate``.

    An IMU without vibration cannot tell a steady straight course from standing, so that a window with an odometer's sample
    or a fix that moves is none.
    """
    from scipy.special import gammaincinv

    spec, initial, std = log.imu.spec, log.initial, np.asarray(log.initial.std, dtype=float)
    dt = (log.imu.t[-1] - initial.t) / len(log.imu.t)
    width = max(2, round(window_s / dt))
    count = len(log.imu.t) // width
    ends = log.imu.t[: count * width].reshape(count, width)[:, -1]
    square, change, means = np.zeros(count), np.zeros(count), []
    change[:1] = np.inf
    for triad, samples in ((spec.accel, log.imu.accel), (spec.gyro, log.imu.gyro)):
        windows = samples[: count * width].reshape(count, width, 3)
        means.append(windows.mean(axis=1))
        variance = sample_variance(triad, dt)
        square += ((windows - means[-1][:, None]) ** 2).sum(axis=(1, 2)) / variance
        change[1:] += (np.diff(means[-1], axis=0) ** 2).sum(axis=1) / (2.0 * variance / width)
    passes = fraction("zero-velocity pass_rate", pass_rate)
    # Tilt hides a steady braking, but it does not last through two windows below the speed that other sensors see.
    quiet = (square < 2.0 * gammaincinv(3.0 * (width - 1), passes)) & (change < 2.0 * gammaincinv(3.0, passes))
    gravity = float(earth.gravity(initial.lat, initial.h))
    force_std = mean_std(spec.accel, std[9:12], width * dt, gravity)
    rate_std = np.hypot(mean_std(spec.gyro, std[12:15], width * dt, 0.0), spec.gyro.g_sensitivity * gravity)
    force, rate = means[0] - initial.accel_bias, means[1] - initial.gyro_bias
    upright = np.abs(np.linalg.norm(force, axis=1) - gravity) < SIGMAS * force_std
    # Three axes; the Earth's own turn is part of it.
    unturned = np.linalg.norm(rate, axis=1) < SIGMAS * np.sqrt(3.0) * rate_std + earth.RATE
    return ends[quiet & upright & unturned & _unmoved(log, ends, width * dt)]


def sample_variance(spec: TriadSpec, dt: float) -> float:
    """Of one sample at rest; an undithered rounding may toggle by a bit, variance up to a quarter of its square."""
    white = spec.white_noise**2 / dt
    rounding = 0.25 * spec.resolution**2 if white < DITHERED * spec.resolution**2 else 0.0
    return max(white + rounding, 1e-16)


def mean_std(spec: TriadSpec, bias_std: Array, duration: float, load: float) -> float:
    """1 sigma of a window's mean at rest on one axis: bias as known and as it drifts, scale under ``load``, noise."""
    parts = [bias_std.max(), spec.gauss_markov_sigma(), spec.scale_factor * load, spec.white_noise / np.sqrt(duration)]
    return float(np.linalg.norm(parts))


def _unmoved(log: SensorLog, ends: Array, duration: float) -> NDArray[np.bool_]:
    """Whether no odometer's sample and no GNSS velocity within each window is too large for noise."""
    found = np.ones(len(ends), dtype=bool)
    tests = []
    if log.odometer is not None:
        spec = log.odometer.spec
        tests.append((log.odometer.t - spec.latency_s, np.abs(log.odometer.speed), spec.measurement_std()))
    if log.gnss is not None:
        spread = log.gnss.measurement_std()[:, 3:].max(axis=1)
        tests.append((log.gnss.t - log.gnss.spec.latency_s, np.abs(log.gnss.v_n).max(axis=1), spread))
    for t, speed, std in tests:
        at = t[speed > np.maximum(SIGMAS * std, 1e-3)]
        found &= np.searchsorted(at, ends) == np.searchsorted(at, ends - duration)
    return found
