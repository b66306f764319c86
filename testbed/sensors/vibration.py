"""Engine vibration on the IMU: sinusoids tied to the shaft speed, and band noise.

A sample is the mean over its interval, so a sinusoid near or beyond the sample rate appears attenuated and aliased, as in
a real part. Accelerations in g, rates in °/s, along b.
"""

from __future__ import annotations

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array
from testbed.sensors.config import Tone, Vibration
from testbed.sensors.draws import Draws


def generate(config: Vibration, start: float, t: Array, engine_rpm: Array | None, draws: Draws) -> tuple[Array, Array]:
    """Mean acceleration (n,3) in g and rate (n,3) in °/s of the vibration over the intervals that end at ``t``."""
    accel, gyro = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    strength = np.ones(len(t))
    if engine_rpm is not None and config.rpm_nominal is not None:
        strength = (engine_rpm / config.rpm_nominal) ** 2
    edges = np.concatenate([[start], t])
    rng = draws.noise("imu.vibration.tones")
    for tone in config.tones:
        phases = rng.uniform(0.0, 2.0 * np.pi, 6)
        turned = _shaft_phase(tone, edges, engine_rpm)
        for amplitudes, out, offsets in ((tone.accel_g, accel, phases[:3]), (tone.gyro_dps, gyro, phases[3:])):
            for axis in np.flatnonzero(amplitudes):
                out[:, axis] += amplitudes[axis] * strength * _interval_means(turned + offsets[axis])
    if config.band_hz is not None:
        rng = draws.noise("imu.vibration.band")
        noise = _band_noise(config.band_hz, t, start, rng)
        accel += strength[:, None] * noise[:, :3] * np.array(config.band_accel_g)
        gyro += strength[:, None] * noise[:, 3:] * np.array(config.band_gyro_dps)
    return accel, gyro


def _shaft_phase(tone: Tone, edges: Array, engine_rpm: Array | None) -> Array:
    """Phase of a tone at the interval edges, rad."""
    if tone.order is not None and engine_rpm is not None:
        turns = np.cumsum(engine_rpm / 60.0 * np.diff(edges))
        return 2.0 * np.pi * tone.order * np.concatenate([[0.0], turns])
    if tone.frequency_hz is None:
        raise InputError(
            "[sensors.imu.vibration] tones: the trajectory has no column engine_rpm, so a tone needs frequency_hz"
        )
    return 2.0 * np.pi * tone.frequency_hz * (edges - edges[0])


def _interval_means(phase: Array) -> Array:
    """Mean of sin over each interval whose edges have these phases; a standing phase gives the sine itself."""
    half = 0.5 * np.diff(phase)
    return np.sin(phase[:-1] + half) * np.sinc(half / np.pi)


def _band_noise(band_hz: tuple[float, float], t: Array, start: float, rng: np.random.Generator) -> Array:
    """(n,6) independent noises of unit variance inside a band, made by a fourth-order Butterworth band-pass."""
    from scipy.signal import butter, sosfilt

    rate = len(t) / (t[-1] - start)
    low, high = band_hz
    if not 0.0 < low < high < 0.5 * rate:
        raise InputError(
            f"[sensors.imu.vibration] band_hz: [{low:g}, {high:g}] must rise and lie between 0 and {0.5 * rate:g} Hz, half the rate"
        )
    sections = butter(2, (low, high), btype="bandpass", fs=rate, output="sos")
    settle = int(10.0 * rate / (high - low))
    noise = sosfilt(sections, rng.standard_normal((len(t) + settle, 6)), axis=0)[settle:]
    impulse = np.zeros(settle + 1)
    impulse[0] = 1.0
    return noise / np.sqrt(np.sum(sosfilt(sections, impulse) ** 2))
