"""The steps of the IMU chain against their closed forms, one at a time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from analytic_flight import analytic_flight

from estimators.core.strapdown import integrate
from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.specs import GAUSS_MARKOV_PEAK
from testbed.physics.earth import G0, position_difference
from testbed.physics.interpolate import point_state
from testbed.sensors import sense_flight, static_log
from testbed.sensors.config import ImuConfig, InitialConfig
from testbed.sensors.draws import Draws
from testbed.sensors.imu import Motion, butterworth, motion_of, sense_imu
from testbed.sensors.registry import SensorsConfig

RATE = 100.0


def motion(n=1000, w=(0.1, -0.2, 0.3), f=(1.0, 2.0, -9.0), rate=RATE, **extra):
    w, f = np.broadcast_to(np.array(w, float), (n, 3)), np.broadcast_to(np.array(f, float), (n, 3))
    return Motion(0.0, np.arange(1, n + 1) / rate, w, f, **extra)


def sense(table, moving=None, seed=1, run=0):
    return sense_imu(validate(ImuConfig, table, "test"), moving or motion(), Draws(seed, run))


def test_ideal_imu_is_truth():
    imu, bias, constants = sense({})
    assert np.array_equal(imu.gyro, motion().w_ib_b)
    assert np.array_equal(imu.accel, motion().f_b)
    assert not bias["gyro"].any()
    assert not any(np.any(v) for v in constants.values())


def test_scale_factor():
    imu, _, constants = sense({"gyro_scale_factor_ppm": 2000.0, "accel_scale_factor_pct": 1.0})
    assert np.allclose(imu.gyro, motion().w_ib_b * (1.0 + constants["gyro_scale_factor"]), rtol=1e-14)
    assert np.allclose(imu.accel, motion().f_b * (1.0 + constants["accel_scale_factor"]), rtol=1e-14)
    assert np.all(constants["gyro_scale_factor"] != 0.0)


def test_misalignment_is_a_rotation():
    """A rotated triad measures the same length, and differs by the small-angle cross product to second order."""
    imu, _, constants = sense({"accel_misalignment_deg": 0.5})
    f = motion().f_b[0]
    matrix = constants["accel_misalignment"]
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert np.allclose(imu.accel, f @ matrix.T, atol=1e-13)
    turn = np.array([matrix[1, 2], matrix[2, 0], matrix[0, 1]])
    assert np.allclose(imu.accel[0], f - np.cross(turn, f), atol=20.0 * np.sum(turn**2))


def test_nonorthogonality_tilts_the_axes():
    _, _, constants = sense({"gyro_nonorthogonality_deg": 0.05})
    axes = constants["gyro_misalignment"]
    assert np.allclose(np.linalg.norm(axes, axis=1), 1.0, atol=1e-14)
    cosines = [axes[0] @ axes[1], axes[0] @ axes[2], axes[1] @ axes[2]]
    assert 1e-5 < np.max(np.abs(cosines)) < 5.0 * np.radians(0.05)


def test_nonlinearity_departs_by_what_the_data_sheet_says():
    """The best straight line through the error of a full sweep leaves a largest departure of 0.1 % of the range."""
    sweep = np.linspace(-1.0, 1.0, 2001)[:, None] * np.radians([300.0, 300.0, 300.0])
    swept = dataclasses.replace(motion(2001), w_ib_b=sweep)
    imu, _, constants = sense({"gyro_range_dps": 300.0, "gyro_nonlinearity_pctfs": 0.1}, swept)
    error = imu.gyro[:, 0] - sweep[:, 0]
    inside = np.abs(imu.gyro[:, 0]) < np.radians(299.5)  # the rest saturates
    error = error[inside]
    assert np.max(np.abs(error)) == pytest.approx(1e-3 * np.radians(300.0), rel=1e-3)
    assert abs(constants["gyro_nonlinearity"][0]) == pytest.approx(1e-3 * np.radians(300.0))
    assert abs(imu.gyro[1000, 0]) < 1e-15  # nothing at rest


def test_g_sensitivity():
    imu, bias, constants = sense({"gyro_g_sensitivity_dpspg": 0.05})
    expected = motion().w_ib_b[0] + constants["gyro_g_sensitivity"] @ motion().f_b[0]
    assert np.allclose(imu.gyro, expected, atol=1e-15)
    assert not bias["gyro"].any()
    scale = np.std(
        [sense({"gyro_g_sensitivity_dpspg": 0.05}, motion(2), run=r)[2]["gyro_g_sensitivity"] for r in range(200)]
    )
    assert scale == pytest.approx(np.radians(0.05) / G0, rel=4.0 / np.sqrt(2.0 * 1800.0))  # 4 sigma of 1800 draws


def test_lever_arm_under_constant_rotation():
    """Centripetal: w × (w × l), and no Euler term."""
    arm, w = np.array([0.5, -0.3, 0.2]), np.array([0.4, -0.2, 1.1])
    imu, _, _ = sense({"lever_arm_m": arm.tolist()}, motion(w=w))
    assert np.allclose(imu.accel, motion().f_b + np.cross(w, np.cross(w, arm)), atol=1e-13)


def test_lever_arm_under_angular_acceleration():
    """Euler term: a rate that grows by 0.5 rad/s² about z adds alpha × l."""
    t = np.arange(1, 1001) / RATE
    moving = dataclasses.replace(motion(), w_ib_b=np.outer(t - 0.5 / RATE, [0.0, 0.0, 0.5]))
    imu, _, _ = sense({"lever_arm_m": [1.0, 0.0, 0.0]}, moving)
    assert np.allclose(imu.accel[:, 1] - 2.0, 0.5, atol=1e-12)
    assert np.allclose(imu.accel[:, 0] - 1.0, -(((t - 0.5 / RATE) * 0.5) ** 2), atol=1e-12)


def test_turn_on_bias_statistics():
    drawn = [sense({"gyro_turn_on_bias_dps": 3.0}, motion(2), run=r)[1]["gyro"][0] for r in range(200)]
    assert np.std(drawn) == pytest.approx(np.radians(3.0), rel=4.0 / np.sqrt(2.0 * 600.0))  # 4 sigma of 600 draws


def test_known_bias_is_added_exactly():
    given = [-2.45e-4, 1.23e-4, -2.22e-4]
    imu, bias, _ = sense({"gyro_true_bias_radps": given})
    assert np.allclose(imu.gyro - motion().w_ib_b, given, atol=1e-16)
    assert np.allclose(bias["gyro"], given, atol=1e-18)


def test_bias_instability_is_a_gauss_markov_process():
    """Variance and correlation over 20 000 correlation times: sampling error about sqrt(2 / (3·10⁴)), here at 5 sigma."""
    table = {"accel_bias_instability_mg": 0.1, "accel_correlation_time_s": 1.0}
    _, bias, _ = sense(table, motion(2_000_00, rate=10.0))
    b = bias["accel"]
    sigma = 0.1e-3 * G0 / GAUSS_MARKOV_PEAK
    assert np.var(b) == pytest.approx(sigma**2, rel=5.0 * np.sqrt(1.0 / 3e4))
    assert np.mean(b[10:] * b[:-10]) == pytest.approx(sigma**2 * np.exp(-1.0), rel=0.06)


def test_rate_random_walk_grows_with_the_root_of_time():
    table = {"gyro_rrw_dpsqrth3": 54.0}
    ends = [sense(table, motion(100, rate=1.0), run=r)[1]["gyro"][-1] for r in range(300)]
    expected = np.radians(54.0) / 3600.0**1.5 * 10.0
    assert np.std(ends) == pytest.approx(expected, rel=4.0 / np.sqrt(2.0 * 900.0))


def test_measured_is_true_plus_bias():
    table = {
        "model": "ADIS16488",
        "disable": ["scale_factor", "misalignment", "nonlinearity", "g_sensitivity", "white_noise"],
    }
    imu, bias, _ = sense(table)
    lsb = np.radians(3.052e-7)
    assert np.allclose(imu.gyro, motion().w_ib_b + bias["gyro"], atol=lsb)
    assert np.allclose(imu.accel, motion().f_b + bias["accel"], atol=1.221e-8 * G0)


def test_white_noise_density_at_any_rate():
    for rate in (50.0, 400.0):
        imu, _, _ = sense({"gyro_arw_dpsqrth": 2.0}, motion(30000, rate=rate))
        sigma = np.radians(2.0) / 60.0 * np.sqrt(rate)
        assert np.std(imu.gyro - motion(1).w_ib_b) == pytest.approx(sigma, rel=4.0 / np.sqrt(2.0 * 9e4))


def test_temperature_moves_bias_and_scale():
    profile = {"time_s": [0.0, 10.0], "celsius": [25.0, 45.0]}
    table = {"gyro_bias_temperature_dpspk": 0.005, "accel_scale_temperature_ppmpk": 50.0, "temperature": profile}
    imu, bias, constants = sense(table)
    kelvin = 2.0 * imu.t
    assert np.allclose(bias["gyro"], np.outer(kelvin, constants["gyro_bias_temperature"]), atol=1e-9)
    scale = 1.0 + np.outer(kelvin, constants["accel_scale_temperature"])
    assert np.allclose(imu.accel, motion().f_b * scale, rtol=1e-12)


def test_vibration_follows_the_engine():
    """A tone of order 2 at 3000 rpm is at 100 Hz; its mean over 1 ms keeps sinc(0.1) of the amplitude; power goes with
    the fourth power of the engine speed."""
    n, rate = 4000, 1000.0
    tone = {"order": 2.0, "accel_g": [0.0, 0.0, 0.5]}
    powers = []
    for rpm in (3000.0, 6000.0):
        moving = motion(n, f=(0.0, 0.0, 0.0), rate=rate, engine_rpm=np.full(n, rpm))
        imu, _, _ = sense({"vibration": {"tones": [tone], "rpm_nominal": 3000.0}}, moving)
        spectrum = np.abs(np.fft.rfft(imu.accel[:, 2])) * 2.0 / n
        line = round(2.0 * rpm / 60.0 * n / rate)
        assert np.argmax(spectrum) == line
        expected = 0.5 * G0 * (rpm / 3000.0) ** 2 * np.sinc(line / n)
        assert spectrum[line] == pytest.approx(expected, rel=1e-9)
        powers.append(np.mean(imu.accel[:, 2] ** 2))
    assert powers[1] > 10.0 * powers[0]


def test_vibration_band_noise_has_its_rms_and_band():
    table = {"vibration": {"band_hz": [50.0, 150.0], "band_accel_g": [0.1, 0.0, 0.0]}}
    imu, _, _ = sense(table, motion(200_000, f=(0.0, 0.0, 0.0), rate=1000.0))
    x = imu.accel[:, 0]
    # about 2 · 100 Hz · 200 s independent values: 0.5 % on the rms
    assert np.std(x) == pytest.approx(0.1 * G0, rel=0.02)
    power = np.abs(np.fft.rfft(x)) ** 2
    f = np.fft.rfftfreq(len(x), 1e-3)
    assert power[(f > 50.0) & (f < 150.0)].sum() > 0.8 * power.sum()
    assert not imu.accel[:, 1].any()


@pytest.mark.parametrize("frequency", [1.0, 100.0, 330.0])
def test_bandwidth_gain(frequency):
    """A 330 Hz Butterworth filter at 5 kHz, sine in, settled sine out; the closed form of the bilinear transform."""
    rate, n = 5000.0, 20000
    t = np.arange(1, n + 1) / rate
    moving = motion(n, w=(0, 0, 0), rate=rate)
    moving = dataclasses.replace(moving, w_ib_b=np.outer(np.sin(2.0 * np.pi * frequency * t), [1.0, 0.5, 0.0]))
    imu, _, _ = sense({"gyro_bandwidth_hz": 330.0}, moving)
    tail = slice(n // 2, n)
    basis = np.column_stack([np.sin(2.0 * np.pi * frequency * t), np.cos(2.0 * np.pi * frequency * t)])[tail]
    gain = np.linalg.norm(np.linalg.lstsq(basis, imu.gyro[tail, 0], rcond=None)[0])
    warped = np.tan(np.pi * frequency / rate) / np.tan(np.pi * 330.0 / rate)
    assert gain == pytest.approx(1.0 / np.sqrt(1.0 + warped**4), rel=1e-6)
    if frequency == 330.0:
        assert gain == pytest.approx(np.sqrt(0.5), rel=1e-6)


def test_bandwidth_starts_settled_and_keeps_constants():
    imu, _, _ = sense({"accel_bandwidth_hz": 10.0}, motion(10000))
    assert np.allclose(imu.accel, motion(1).f_b, atol=1e-12)
    b, a = butterworth(10.0, RATE)
    assert b.sum() / a.sum() == pytest.approx(1.0)


def test_saturation():
    imu, _, _ = sense({"gyro_range_dps": 10.0, "accel_range_g": 0.5})
    assert np.allclose(imu.gyro[0], [0.1, -np.radians(10.0), np.radians(10.0)])
    assert np.allclose(imu.accel[0], [1.0, 2.0, -0.5 * G0])


def test_quantisation_error_is_uniform():
    """On a slow ramp the error is uniform over one LSB: variance LSB²/12, here by 60 000 samples over 3 000 steps."""
    lsb = np.radians(0.05)
    ramp = np.linspace(0.0, 3000.3 * lsb, 60000)[:, None] * np.ones(3)
    moving = dataclasses.replace(motion(60000), w_ib_b=ramp)
    imu, _, _ = sense({"gyro_resolution_dps": 0.05}, moving)
    error = imu.gyro - ramp
    assert np.var(error) == pytest.approx(lsb**2 / 12.0, rel=0.01)
    assert np.max(np.abs(error)) <= 0.5 * lsb * (1.0 + 1e-9)
    assert np.allclose(imu.gyro / lsb, np.rint(imu.gyro / lsb), atol=1e-9)


def test_output_noise_is_the_data_sheets_with_coarse_quantisation():
    """ADIS16405 accelerometer: 3.33 mg/LSB, as coarse as its noise. VRW at the output holds within 4 sigma of 9·10⁵."""
    log = static_log("ADIS16405", 100.0, 3000.0, 4, disable=["bias_instability"])
    sigma = 0.2 / 60.0 * np.sqrt(100.0)
    assert np.std(log.imu.accel - log.imu.accel.mean(axis=0)) == pytest.approx(sigma, rel=4.0 / np.sqrt(2.0 * 9e5))


def test_a_step_switched_off_changes_no_other():
    """Differences of logs with and without a step show that step alone."""
    table = {"model": "ADIS16405", "disable": ["quantisation", "saturation", "nonlinearity"]}
    full, bias, constants = sense(table)
    for step in ("turn_on_bias", "bias_instability", "white_noise", "g_sensitivity", "misalignment"):
        less, less_bias, less_constants = sense(table | {"disable": [*table["disable"], step]})
        assert not np.array_equal(less.gyro, full.gyro)
        for name in set(constants) & set(less_constants):
            assert np.array_equal(constants[name], less_constants[name]), (step, name)
        if step == "turn_on_bias":
            assert np.allclose(bias["gyro"] - less_bias["gyro"], constants["gyro_turn_on_bias"], atol=1e-15)
            assert np.allclose(full.gyro - less.gyro, constants["gyro_turn_on_bias"], atol=1e-12)


def test_gyro_figures_leave_the_accelerometer_alone():
    one, _, _ = sense({"model": "ADIS16448"})
    two, _, _ = sense({"model": "ADIS16448", "gyro_arw_dpsqrth": 5.0, "gyro_rrw_dpsqrth3": 3.0})
    assert np.array_equal(one.accel, two.accel)


def test_seed_and_run_decide_everything():
    a, b, c = (sense({"model": "ADIS16488"}, seed=s, run=r)[0] for s, r in ((1, 0), (1, 0), (1, 1)))
    assert np.array_equal(a.gyro, b.gyro)
    assert not np.array_equal(a.gyro, c.gyro)


def test_a_monte_carlo_may_hold_the_turn_on_errors():
    table = validate(ImuConfig, {"model": "ADIS16448"}, "test")
    biases, noises = [], []
    for run in (0, 1):
        imu, _, constants = sense_imu(table, motion(), Draws(3, run, vary=("noise",)))
        biases.append(constants["gyro_turn_on_bias"])
        noises.append(imu.gyro)
    assert np.array_equal(*biases)
    assert not np.array_equal(*noises)


def test_a_longer_log_begins_like_a_shorter_one():
    """Blocks and streams do not depend on the length."""
    short, _, _ = sense({"model": "ADIS16405"}, motion(5000))
    long, _, _ = sense({"model": "ADIS16405"}, motion(20000))
    assert np.array_equal(short.gyro, long.gyro[:5000])


def test_slower_imu_gets_the_means():
    flight = analytic_flight(duration_s=10.0, rate_hz=100.0)
    slow = motion_of(flight, 25.0)
    assert np.allclose(slow.t, np.arange(1, 251) / 25.0, atol=1e-12)
    assert np.allclose(slow.w_ib_b[3], flight.w_ib_b[13:17].mean(axis=0), atol=1e-15)
    coarse = analytic_flight(duration_s=10.0, rate_hz=25.0)
    assert np.allclose(slow.f_b, coarse.f_b[1:], atol=1e-5)  # both are the same integrals
    for wrong in (30.0, 200.0):
        with pytest.raises(InputError, match="whole multiple"):
            motion_of(flight, wrong)


def test_log_of_a_flight_is_on_the_agreed_grid():
    flight = analytic_flight(duration_s=5.0, rate_hz=100.0)
    log, errors = sense_flight(SensorsConfig(), InitialConfig(perfect=True), flight, 1)
    assert np.array_equal(log.imu.t, flight.t[1:])
    assert np.array_equal(log.imu.gyro, flight.w_ib_b[1:])
    assert log.initial.t == flight.t[0]
    assert errors.gyro_bias.shape == log.imu.gyro.shape


def test_imu_off_the_reference_point_navigates_along_its_own_path():
    """Strapdown of an ideal IMU 1 m off the centre follows that point of a hard flight (4 g, 1 rad/s) within 1 cm in 60 s:
    the rotational terms come from mean rates, an error of second order in the interval (3 mm here, 12 mm at 50 Hz)."""
    flight = analytic_flight(duration_s=60.0, rate_hz=100.0)
    arm = [1.0, -0.4, 0.3]
    config = validate(SensorsConfig, {"imu": {"lever_arm_m": arm}}, "test")
    log, _ = sense_flight(config, InitialConfig(perfect=True), flight, 1)
    n, zero = len(log.imu.t), np.zeros(3)
    place, v, q = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    s = log.initial
    start = (s.lat, s.lon, s.h, s.v_n, s.q_nb, zero, zero)
    integrate(s.t, log.imu.t, log.imu.gyro, log.imu.accel, *start, place, v, q)
    lat, lon, h, v_true = point_state(flight, flight.t[1:], np.array(arm))
    error = np.column_stack(position_difference(*place.T, lat, lon, h))
    assert np.max(np.abs(error)) < 0.01
    assert np.max(np.abs(v - v_true)) < 1e-3
