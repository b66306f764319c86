"""The Allan analysis gives back what is known: of simple noises, of its own model curve, and of every catalogue IMU."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from testbed.base.errors import InputError
from testbed.data.specs import GAUSS_MARKOV_PEAK
from testbed.sensors import allan, allan_fit, list_sensors, static_log

NBS14 = np.array([892, 809, 823, 798, 671, 644, 883, 903, 677], dtype=float)
"""The nine frequency data of NBS Monograph 140, annex 8.E, as in Riley, NIST SP 1065, section 12.4."""

NOISY = [name for name in list_sensors()["imu"] if name != "ideal"]


def test_overlapping_deviation_of_the_published_data_set(monkeypatch):
    """NIST SP 1065, table 30: 91.22945 at 1 and 85.95287 at 2 samples."""
    monkeypatch.setattr(allan, "FEWEST_CLUSTERS", 2)
    curve = allan.allan_deviation(NBS14, 1.0)
    assert curve.deviation[curve.tau == 1.0] == pytest.approx(91.22945, abs=1e-5)
    assert curve.deviation[curve.tau == 2.0] == pytest.approx(85.95287, abs=1e-5)


def test_white_noise_falls_with_the_root_of_the_cluster_time():
    x = np.random.default_rng(1).standard_normal(200_000)
    curve = allan.allan_deviation(x, 100.0)
    short = curve.tau < 1.0  # more than 2000 clusters: 2 % and less
    assert np.allclose(curve.deviation[short], 0.1 / np.sqrt(curve.tau[short]), rtol=0.05)


def test_markov_curve_against_its_integral():
    """Allan variance is the filtered spectrum: 2 ∫ S(f) sin⁴(pi f tau) / (pi f tau)² df, with S one-sided."""
    f = np.linspace(1e-6, 60.0, 2_000_001)
    for tau in (0.1, 0.3, 1.89, 20.0):
        spectrum = 4.0 / (1.0 + (2.0 * np.pi * f) ** 2)
        integral = np.trapezoid(2.0 * spectrum * np.sin(np.pi * f * tau) ** 4 / (np.pi * f * tau) ** 2, f)
        assert allan.model_deviation(np.array([tau]), 0.0, 1.0, 1.0, 0.0)[0] ** 2 == pytest.approx(integral, rel=5e-3)


def test_markov_peak_is_where_the_specification_puts_it():
    tau = np.linspace(0.5, 5.0, 4501)
    curve = allan.model_deviation(tau, 0.0, 1.0, 1.0, 0.0)
    assert curve.max() == pytest.approx(GAUSS_MARKOV_PEAK, abs=1e-5)
    assert tau[curve.argmax()] == pytest.approx(1.893, abs=2e-3)


def test_series_near_zero_meets_the_closed_form():
    assert allan_fit.markov_shape(np.array([0.02 - 1e-9]))[0] == pytest.approx(
        allan_fit.markov_shape(np.array([0.02]))[0], rel=1e-6
    )


def test_fit_returns_the_coefficients_of_a_model_curve():
    tau = np.geomspace(0.01, 5000.0, 60)
    exact = allan.Curve(tau, allan.model_deviation(tau, 0.01, 0.002, 80.0, 4e-5))
    fit = allan.fit_allan(exact, 1e7)  # long enough for every term to stand out of the sampling error
    assert fit.white_noise == pytest.approx(0.01, rel=1e-3)
    assert fit.bias_instability == pytest.approx(GAUSS_MARKOV_PEAK * 0.002, rel=1e-2)
    assert fit.correlation_time_s == pytest.approx(80.0, rel=2e-2)
    assert fit.rate_random_walk == pytest.approx(4e-5, rel=1e-2)


@pytest.mark.parametrize("model", NOISY)
def test_static_log_gives_its_data_sheet_back(model):
    """One hour at rest: random walks within 3 %; bias instability within 4 sigma of what 3 x 36 correlation times allow."""
    log = static_log(model, 100.0, 3600.0, seed=2)
    table = allan.analyse(log).set_index(["triad", "figure", "axis"])
    for triad, figure in (("gyro", "ARW"), ("accel", "VRW")):
        assert abs(table.loc[(triad, figure, "all"), "difference_pct"]) < 3.0
        spec = getattr(log.imu.spec, triad)
        if spec.bias_instability:
            allowed = 400.0 * np.sqrt(spec.correlation_time_s / (2.0 * 3.0 * 3600.0))
            row = table.loc[(triad, "bias instability", "all")]
            if spec.rate_random_walk and table.loc[(triad, "RRW", "all"), "note"]:
                # An hour does not tell this walk from the flat, which takes it up: then its own sigma knows.
                allowed = 300.0 * row["std"] / row["data_sheet"]
            assert abs(row["difference_pct"]) < allowed


def test_bias_instability_and_random_walk_are_unbiased():
    """The unit with a rate random walk, six logs of 6 h: their mean within the acceptance limits of one log."""
    tables = [allan.analyse(static_log("ahrs-lstm-2022", 5.0, 21600.0, seed=s)) for s in range(6)]
    found = [t.set_index(["triad", "figure", "axis"])["difference_pct"] for t in tables]
    assert abs(np.mean([f["gyro", "bias instability", "all"] for f in found])) < 6.0
    assert abs(np.mean([f["gyro", "RRW", "all"] for f in found])) < 12.0
    assert abs(np.mean([f["gyro", "ARW", "all"] for f in found])) < 1.0


def simulated(seed, white, markov, time, walk, n=36_000, rate=5.0):
    """Two hours at 5 Hz of noise with known coefficients."""
    rng, dt = np.random.default_rng(seed), 1.0 / rate
    decay = np.exp(-dt / time)
    drive = rng.standard_normal(n) * np.sqrt(1.0 - decay**2)
    drive[0] = rng.standard_normal()
    slow = lfilter([1.0], [1.0, -decay], markov * drive) + np.cumsum(walk * np.sqrt(dt) * rng.standard_normal(n))
    return white * np.sqrt(rate) * rng.standard_normal(n) + slow


def test_nothing_is_invented_where_there_is_only_white_noise():
    """Five records: no bias instability, no random walk, and their limits are above zero."""
    for seed in range(5):
        fit = allan.fit_allan(allan.allan_deviation(simulated(seed, 0.01, 0.0, 1.0, 0.0), 5.0), 7200.0)
        assert (fit.bias_instability, fit.rate_random_walk) == (0.0, 0.0)
        assert min(fit.limits["bias_instability"], fit.limits["rate_random_walk"]) > 0.0
        assert abs(fit.white_noise - 0.01) < 3.5 * fit.white_noise_std < 3.5e-4


def test_intervals_hold_the_coefficients():
    """Twelve records. A sigma right to 60 % upwards and downwards: chi-square of 12 z within 12/1.6^2 .. 12*1.6^2 (99 %)."""
    found = []
    for seed in range(12):
        curve = allan.allan_deviation(simulated(seed, 0.01, 0.002, 80.0, 0.0), 5.0)
        found.append(allan.fit_allan(curve, 7200.0, walk=False))
    for key, true in (("white_noise", 0.01), ("bias_instability", 0.002 * GAUSS_MARKOV_PEAK)):
        z = np.array([(getattr(f, key) - true) / getattr(f, f"{key}_std") for f in found])
        assert 12 / 1.6**2 / 2.0 < (z**2).sum() < 12 * 1.6**2


def test_sigmas_of_a_random_walk_are_not_half_the_value():
    """A walk that stands out is known to better than half, and its interval holds it."""
    curve = allan.allan_deviation(simulated(3, 0.01, 0.0, 1.0, 5e-4), 5.0)
    fit = allan.fit_allan(curve, 7200.0, markov=False)
    assert fit.rate_random_walk_std < 0.25 * fit.rate_random_walk
    assert abs(fit.rate_random_walk - 5e-4) < 3.0 * fit.rate_random_walk_std


def test_sampling_covariance_is_that_of_white_noise():
    """Degrees of freedom of the overlapping estimator, white noise: Riley, NIST SP 1065, table 5."""
    n, dt = 100_000, 1.0
    sizes = np.array([1.0, 4.0, 30.0, 300.0])
    curve = allan.Curve(sizes * dt, 1.0 / np.sqrt(sizes))
    fit = allan_fit._Fit(curve, n * dt, 1)
    variances = np.array([1.0, 0.0, 0.0])
    freedom = 2.0 / sizes**2 / np.diag(fit.covariance(variances, 1.0))
    book = (1.5 * (n - 1) / sizes - 2.0 * (n - 2) / n) * 4.0 * sizes**2 / (4.0 * sizes**2 + 5.0)
    np.testing.assert_allclose(freedom, book, rtol=0.06)  # the book's formula is itself a fit


def test_a_common_value_that_fits_no_axis_is_not_given():
    log = static_log("ADIS16448", 20.0, 600.0, seed=4)
    gyro = log.imu.gyro * np.array([1.0, 1.0, 6.0])
    bare = dataclasses.replace(log, imu=dataclasses.replace(log.imu, gyro=gyro, spec=type(log.imu.spec)()))
    table = allan.analyse(bare).set_index(["triad", "figure", "axis"])
    row = table.loc[("gyro", "ARW", "all")]
    assert np.isnan(row["fitted"]) and "axes differ" in row["note"]
    assert table.loc[("accel", "VRW", "all"), "note"] == ""


def test_no_noise_no_figures():
    assert allan.analyse(static_log("ideal", 100.0, 60.0)).empty


def test_recording_without_a_specification_is_fitted_in_full():
    log = static_log("ADIS16488", 20.0, 7200.0, seed=1)
    bare = dataclasses.replace(log, imu=dataclasses.replace(log.imu, spec=type(log.imu.spec)()))
    table = allan.analyse(bare).set_index(["triad", "figure", "axis"])
    assert np.isnan(table["data_sheet"]).all()
    assert table.loc[("gyro", "ARW", "all"), "fitted"] == pytest.approx(0.3, rel=0.03)
    assert table.loc[("gyro", "bias instability", "all"), "fitted"] == pytest.approx(6.25, rel=0.4)


def test_plot_is_written(tmp_path):
    allan.plot(static_log("ahrs-lstm-2022", 20.0, 600.0), tmp_path / "allan.png")
    assert (tmp_path / "allan.png").stat().st_size > 10_000


def test_gaps_and_short_logs_are_refused():
    log = static_log("ADIS16448", 100.0, 10.0)
    t = log.imu.t.copy()
    t[500:] += 1.0
    with pytest.raises(InputError, match="gap"):
        allan.analyse(dataclasses.replace(log, imu=dataclasses.replace(log.imu, t=t)))
    with pytest.raises(InputError, match="too few"):
        allan.analyse(static_log("ADIS16448", 100.0, 0.5))
