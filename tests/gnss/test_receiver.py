"""The receiver: fixes of perfect observations, the chi-square test, and a recorded static set against RTKLIB and sidereon."""

from pathlib import Path

import numpy as np
import pytest
from analytic_flight import analytic_flight
from scipy.stats import binom

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.observations import GnssObservations
from testbed.gnss.receiver import EXCLUDED, Received, dilution, solve
from testbed.gnss.recorded import read_rinex
from testbed.gnss.sense import fixes_of
from testbed.physics import earth, ecef
from testbed.physics.interpolate import point_state
from testbed.sensors.config import GnssConfig
from testbed.sensors.draws import Draws
from testbed.sensors.gnss import sense_gnss

DATA = Path(__file__).parents[3] / "shared" / "data" / "rinex"
OBSERVATIONS = DATA / "SEPT078M_GE.21O"
ARM = (1.0, 0.5, -0.3)
QUIET = ["orbit_clock", "iono", "tropo", "multipath", "code_noise", "rate_noise", "fading"]
SIGMA = 2.0


def satellites(flight, seed=1, arm=ARM, **keys):
    config = validate(GnssConfig, {"mode": "satellites", "model": "module-class", "lever_arm_m": list(arm)} | keys, "s")
    return sense_gnss(config, flight, Draws(seed), (0.0, 0.0, 0.0))


def test_without_errors_the_fix_is_the_truth():
    """1 mm and 0.1 mm/s at every epoch of a flight with 4 g and banks of 60 degrees, a free-running clock aboard."""
    flight = analytic_flight(60.0, 100.0)
    for systems in (["gps"], ["gps", "galileo"]):
        made, drawn = satellites(flight, satellites={"disable": QUIET, "systems": systems})
        fixes = made["gnss"]
        lat, lon, h, v_n = point_state(flight, fixes.t, np.array(ARM))
        off = np.array(earth.position_difference(fixes.lat, fixes.lon, fixes.h, lat, lon, h))
        assert len(fixes.t) > 290 and np.abs(off).max() < 1e-3 and np.abs(fixes.v_n - v_n).max() < 1e-4
        assert np.abs(drawn["gnss_clock_bias_m"]).max() > 100.0  # it was there to be found


def white_epochs(epochs, seed, fault=0.0):
    """Epochs of eleven satellites with white errors at a fixed place; the first has a step of ``fault`` (m)."""
    rng = np.random.default_rng(seed)
    lat, lon = 0.8, 0.2
    r, axes = np.array(ecef.geodetic_to_ecef(lat, lon, 100.0)), np.array(ecef.north_east_down(lat, lon))
    azimuth = np.arange(11) * 2.0 * np.pi * 3 / 11
    elevation = np.radians([35.0, 12.0, 70.0, 25.0, 50.0, 15.0, 40.0, 20.0, 60.0, 30.0, 10.0])
    lines = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)]
    )
    x = r + 2.3e7 * lines @ axes
    pseudorange = 2.3e7 + 1234.5 + SIGMA * rng.standard_normal((epochs, 11))
    pseudorange[:, 0] += fault
    m = epochs * 11
    return Received(
        np.arange(0, m + 1, 11),
        np.ones(m, dtype=np.int64),
        np.tile(x, (epochs, 1)),
        np.zeros((m, 3)),
        pseudorange.ravel(),
        np.zeros(m),
        np.full(m, SIGMA),
        np.full(m, 0.05),
    ), lines


def test_false_alarms_of_the_test_are_as_many_as_stated():
    """1e5 epochs without a fault: the count of exceedances lies in the central 95 % of the binomial distribution; the
    statistic's mean is its degrees of freedom, 7, to four deviations of such a mean."""
    epochs, chance = 100_000, 1e-3
    received, _ = white_epochs(epochs, 1)
    fixes = solve(received, chance)
    alarms = int(np.sum(np.bincount(np.arange(len(fixes.used)) // 11, fixes.used != 1, epochs) > 0))
    low, high = binom.ppf([0.025, 0.975], epochs, chance)
    assert low <= alarms <= high
    assert fixes.test[:, 1].max() == fixes.test[:, 1].min() == 7
    assert fixes.test[:, 0].mean() == pytest.approx(7.0, abs=4.0 * np.sqrt(14.0 / epochs))


def test_a_step_is_found_and_the_right_satellite_left_out():
    """30 m on a satellite whose least detectable bias is below 20 m: found in 99 %, the right one excluded in 95 %."""
    epochs = 2000
    received, lines = white_epochs(epochs, 2, fault=30.0)
    h = np.column_stack([-lines, np.ones(11)])
    redundancy = 1.0 - (h @ np.linalg.inv(h.T @ h) @ h.T)[0, 0]
    # Baarda: noncentrality 5.2 squared for false alarms of 1e-3 with 7 degrees of freedom and a power of 0.8
    assert SIGMA * 5.2 / np.sqrt(redundancy) < 20.0
    fixes = solve(received, 1e-3)
    excluded = (fixes.used == EXCLUDED).reshape(epochs, 11)
    lost = (fixes.used == 0).reshape(epochs, 11).all(axis=1)
    assert np.mean(excluded.any(axis=1) | lost) >= 0.99
    assert np.mean(excluded[:, 0]) >= 0.95
    assert np.nanmax(np.abs(fixes.place[:, 2] - 100.0)) < 40.0


def test_the_stated_deviations_are_those_of_the_errors():
    """White errors: the spread of 20,000 fixes is what the receiver states, to four deviations of such an estimate (2 %)."""
    received, _ = white_epochs(20_000, 3)
    fixes = solve(received, 0.0)
    off = np.column_stack(earth.position_difference(*fixes.place.T, 0.8, 0.2, 100.0))
    assert np.std(off, axis=0) == pytest.approx(fixes.std[0, :3], rel=0.02)
    assert np.abs(np.mean(off, axis=0)).max() < 4.0 * fixes.std[0, 2] / np.sqrt(20_000)


def test_the_dilution_of_a_fix_is_that_of_its_satellites():
    """Without weights; lines of sight from a fix metres off are turned by a ten millionth."""
    received, lines = white_epochs(50, 3)
    fixes = solve(received, 0.0)
    hdop, vdop, tdop, _ = dilution(lines, np.ones(11, dtype=np.int64))
    assert np.allclose(fixes.dop, [hdop, vdop, tdop], rtol=1e-5)


def test_too_few_satellites_give_no_fix():
    flight = analytic_flight(12.0, 100.0)
    keep = [{"start_s": 3.0, "end_s": 9.0, "highest": 3}]
    made, _ = satellites(flight, satellites={"keep": keep})
    fixes, raw = made["gnss"], made["gnss_raw"]
    inside = (raw.t >= 3.0) & (raw.t < 9.0)
    assert not ((fixes.t >= 3.0) & (fixes.t < 9.0)).any() and len(np.unique(raw.sv[inside])) <= 3
    assert (raw.used[inside] == 0).all() and (raw.used[~inside] == 1).any()


def test_the_recorded_static_set():
    """15 minutes of a mosaic-X5 whose place is known to some cm: H95 at most 1.6 m and V95 2.5 m, and the mean within 0.5 m
    (0.6 m in height) of RTKLIB's and sidereon's: 0.63, 0.58, 1.39 m and 0.62, 0.66, 1.19 m north, east, down."""
    if not OBSERVATIONS.is_file():
        pytest.skip("needs the shared observation file")
    raw, start = read_rinex(OBSERVATIONS, DATA / "SEPT078M.21P")
    assert start.isoformat() == "2021-03-19T12:00:00" and len(raw.satellites()) > 18
    gps = GnssObservations(**{key: v[raw.sv < 200] if isinstance(v, np.ndarray) else v for key, v in vars(raw).items()})
    truth = ecef.ecef_to_geodetic(-3962108.6617, 3381309.5232, 3668678.6410)
    for observations, name in ((gps, "GPS"), (raw, "both")):
        fixes = fixes_of(observations)[0]
        off = np.array(earth.position_difference(fixes.lat, fixes.lon, fixes.h, *truth))
        assert len(fixes.t) == 898, name  # the first and the last have no rate
        assert np.percentile(np.hypot(off[0], off[1]), 95) <= 1.6 and np.percentile(np.abs(off[2]), 95) <= 2.5, name
        if name == "GPS":
            for theirs in ([0.63, 0.58, 1.39], [0.62, 0.66, 1.19]):
                away = off.mean(axis=1) - theirs
                assert np.abs(away[:2]).max() <= 0.5 and abs(away[2]) <= 0.6
        # at rest, from differences of the carrier: millimetres of noise, and what the ionosphere drifts
        assert np.abs(fixes.v_n.mean(axis=0)).max() < 0.02


def test_damaged_observations_are_named(tmp_path):
    if not OBSERVATIONS.is_file():
        pytest.skip("needs the shared observation file")
    lines, path = OBSERVATIONS.read_text().splitlines()[:60], tmp_path / "short.21O"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"short\.21O: line 60: .* but the file ends|names 19 satellites"):
        read_rinex(path, DATA / "SEPT078M.21P")
    path.write_text("\n".join([*lines[:22], lines[22].replace(".", "x"), *lines[23:41]]))
    with pytest.raises(InputError, match="line 23: a number is damaged"):
        read_rinex(path, DATA / "SEPT078M.21P")
    with pytest.raises(InputError, match="a RINEX 3 observation file is needed"):
        read_rinex(DATA / "SEPT078M.21P", DATA / "SEPT078M.21P")
