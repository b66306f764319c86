"""Solutions of others: known shifts, turns and drifts come back as figures, in each file format."""

from __future__ import annotations

from pathlib import Path

import formats_flight
import numpy as np
import pandas as pd
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from testbed.base.errors import InputError
from testbed.cli import commands
from testbed.data.records import Trajectory
from testbed.formats import solutions
from testbed.formats.solutions import Track
from testbed.scoring.tracks import score_track


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    """1800 m of a climbing turn."""
    return formats_flight.make_trajectory(60.0)


def enu(truth: Trajectory) -> np.ndarray:
    first = truth.lat[0], truth.lon[0], truth.h[0]
    return np.column_stack(pymap3d.geodetic2enu(truth.lat, truth.lon, truth.h, *first, deg=False))


def tum(truth: Trajectory, path: Path, positions: np.ndarray, turn: Rotation | None = None) -> Path:
    """As ROS writes it: east-north-up, forward-left-up, scalar last; scipy turns what the bench has."""
    q_nb = Rotation.from_quat(truth.q_nb[:, [1, 2, 3, 0]])
    to_enu = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    flu = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    q = (turn or Rotation.identity()) * to_enu * q_nb * flu
    np.savetxt(path, np.column_stack([truth.t, positions, q.as_quat()])[::10], fmt="%.9f")
    return path


def score(truth: Trajectory, path: Path, alignment: str = "none") -> dict[str, float]:
    return score_track(truth, solutions.read(path, solutions.origin_of(truth)), alignment).metrics


def test_a_tum_file_of_the_truth_has_no_error(truth: Trajectory, tmp_path: Path) -> None:
    """But for its nine digits: 1e-9 m and rad."""
    found = score(truth, tum(truth, tmp_path / "a.tum", enu(truth)))
    assert found["rmse_position_3d_m"] < 1e-5  # truth itself goes through degrees of 1e-16 rad, a nanometre
    assert found["rmse_attitude_deg"] < 1e-6
    assert found["rpe_100m_pct"] < 1e-5


def test_a_shift_is_an_error_until_it_is_aligned(truth: Trajectory, tmp_path: Path) -> None:
    path = tum(truth, tmp_path / "a.tum", enu(truth) + np.array([3.0, -4.0, 2.0]))
    found = score(truth, path)
    expected = {"rmse_east_m": 3.0, "rmse_north_m": 4.0, "rmse_down_m": 2.0, "cep_m": 5.0, "r95_m": 5.0}
    assert {k: found[k] for k in expected} == pytest.approx(expected, abs=1e-4)
    assert found["rpe_100m_pct"] < 1e-5  # what is the same at both ends is no drift
    assert score(truth, path, "translation")["rmse_position_3d_m"] < 1e-4


@pytest.mark.parametrize(("alignment", "turn"), [("yaw", [0, 0, 40.0]), ("rigid", [10.0, -20.0, 130.0])])
def test_a_turned_frame_is_found(alignment: str, turn: list[float], truth: Trajectory, tmp_path: Path) -> None:
    rotation = Rotation.from_euler("xyz", turn, degrees=True)
    path = tum(truth, tmp_path / "a.tum", rotation.apply(enu(truth)) + 100.0, rotation)
    track = solutions.read(path, solutions.origin_of(truth))
    found = score_track(truth, track, alignment)
    assert found.metrics["rmse_position_3d_m"] < 1e-4
    assert found.metrics["rmse_attitude_deg"] < 1e-4
    told = np.degrees(rotation.magnitude())
    assert f"turned by {told:.3g}°" in found.aligned
    assert score_track(truth, track).metrics["rmse_position_3d_m"] > 50.0


def test_a_scale_error_is_the_relative_error(truth: Trajectory, tmp_path: Path) -> None:
    """1 % too long: along a turn of 250 m radius the chord of 100 m is 99.3 m, so 0.993 % of the way."""
    path = tum(truth, tmp_path / "a.tum", 1.01 * enu(truth))
    found = score(truth, path)
    chord = 2.0 * 250.0 * np.sin(100.0 / 2.0 / 250.0)
    assert found["rpe_100m_pct"] == pytest.approx(chord / 100.0, rel=0.01)


def test_quantiles_are_those_of_the_data(truth: Trajectory) -> None:
    """Normal errors of sigma 2 m per axis: CEP 1.1774 sigma, R95 2.4477 sigma (Rayleigh); 6000 samples know them to 2 %."""
    origin = solutions.origin_of(truth)
    ned = solutions.local(truth.lat, truth.lon, truth.h, origin)
    ned = ned + 2.0 * np.random.default_rng(4).standard_normal(ned.shape)
    found = score_track(truth, Track("x", truth.t, ned)).metrics
    assert found["cep_m"] == pytest.approx(2.0 * 1.1774, rel=0.04)
    assert found["r95_m"] == pytest.approx(2.0 * 2.4477, rel=0.04)
    assert "rmse_attitude_deg" not in found
    assert "rmse_velocity_3d_mps" not in found


def test_the_command_takes_tables_and_files(
    truth: Trajectory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth.to_frame().to_csv(tmp_path / "truth.csv", index=False)
    frame = truth.to_frame()[::20]
    frame = frame.assign(alt_m=frame["alt_m"] + 1.5, v_north_mps=frame["v_north_mps"] + 0.2)
    frame.drop(columns=["roll_deg", "pitch_deg", "yaw_deg"]).to_csv(tmp_path / "mine.csv", index=False)
    commands.score([tmp_path / "mine.csv"], str(tmp_path / "truth.csv"), "none", tmp_path / "out.csv")
    found = pd.read_csv(tmp_path / "out.csv").iloc[0]
    assert found["rmse_down_m"] == pytest.approx(1.5, abs=1e-3)
    assert found["rmse_velocity_3d_mps"] == pytest.approx(0.2, abs=1e-3)
    assert found["alignment"] == "not aligned"
    assert "mine.csv: not aligned" in capsys.readouterr().out


def test_mistakes_are_told(truth: Trajectory, tmp_path: Path) -> None:
    late = tum(truth, tmp_path / "a.tum", enu(truth))
    rows = np.loadtxt(late)
    np.savetxt(tmp_path / "late.tum", rows + np.array([1e6, *[0.0] * 7]))
    np.savetxt(tmp_path / "short.tum", rows[:, :5])
    np.savetxt(tmp_path / "long.tum", rows * [*[1.0] * 4, *[2.0] * 4])
    (tmp_path / "text.tum").write_text("hello world\n")
    for name, words in {
        "late": "does not overlap the truth",
        "short": "rows of 5 numbers",
        "long": "has not length 1",
        "text": "not a TUM file",
        "none": "no such file",
    }.items():
        with pytest.raises(InputError) as caught:
            score(truth, tmp_path / f"{name}.tum")
        assert words in str(caught.value)
        assert name in str(caught.value)
    with pytest.raises(InputError, match="valid: none, translation, yaw, rigid"):
        score(truth, late, "sim3")


def table(truth: Trajectory, path: Path, edit=lambda f: f) -> Path:
    edit(truth.to_frame()[::20]).to_csv(path, index=False)
    return path


def notes(truth: Trajectory, path: Path) -> tuple[str, ...]:
    return score_track(truth, solutions.read(path, solutions.origin_of(truth))).notes


def test_what_is_scored_is_told(truth: Trajectory, tmp_path: Path) -> None:
    """Nothing of a whole solution; of one of 15 s, or with a gap of 5 s, which part it is."""
    assert notes(truth, table(truth, tmp_path / "a.csv")) == ()
    (told,) = notes(truth, table(truth, tmp_path / "b.csv", lambda f: f[f["time_s"] <= 15.0]))
    assert told == "scored from 0 to 15 s, 15 s of the truth's 60 s"
    (told,) = notes(truth, table(truth, tmp_path / "c.csv", lambda f: f[(f["time_s"] < 20) | (f["time_s"] > 25)]))
    assert told == "the solution has a gap from 19.8 to 25.2 s: not scored there"
    late = solutions.read(table(truth, tmp_path / "d.csv"), solutions.origin_of(truth))
    rows = (truth.t < 20.0) | (truth.t > 25.0)
    cut = Trajectory(
        *(x[rows] for x in (truth.t, truth.lat, truth.lon, truth.h, truth.v_n, truth.q_nb, truth.f_b, truth.w_ib_b))
    )
    assert score_track(cut, late).notes == (
        "the truth has a gap from 19.99 to 25.01 s: the truth is interpolated there",
    )


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (
            lambda f: f.assign(time_s=1e3 * f["time_s"]),
            "are its times in milliseconds? Such a column is called time_ms",
        ),
        (lambda f: f.assign(time_s=1e-3 * f["time_s"]), "are the truth's times in milliseconds"),
        (
            lambda f: f.assign(lat_deg=np.radians(f["lat_deg"]), lon_deg=np.radians(f["lon_deg"])),
            "lat and lon in radians?",
        ),
        (lambda f: f.rename(columns={"lat_deg": "lon_deg", "lon_deg": "lat_deg"}), "are lat and lon exchanged?"),
    ],
)
def test_units_of_a_solution_are_asked_for(edit, words: str, truth: Trajectory, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        notes(truth, table(truth, tmp_path / "mine.csv", edit))
    assert words in str(caught.value) and "mine.csv" in str(caught.value)


def test_velocities_that_are_not_those_of_the_places_are_told(truth: Trajectory, tmp_path: Path) -> None:
    path = table(
        truth,
        tmp_path / "mine.csv",
        lambda f: f.assign(**{f"v_{a}_mps": 3.6 * f[f"v_{a}_mps"] for a in ("north", "east")}),
    )
    assert any("the solution: the velocities say 3.6 times" in note for note in notes(truth, path))


def test_a_noisy_solution_at_rest_is_not_doubted(truth: Trajectory) -> None:
    """Fixes of 4 m about each axis that stand still for 600 s, with velocities of 0.05 m/s."""
    rng = np.random.default_rng(5)
    t = np.arange(600.0)
    zero = np.zeros(600)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (600, 1))
    place = [np.full(600, x[0]) for x in (truth.lat, truth.lon, truth.h)]
    rest = Trajectory(t, *place, np.column_stack([zero] * 3), still, np.zeros((600, 3)), np.zeros((600, 3)))
    noisy = Track("x", t, 4.0 * rng.standard_normal((600, 3)), 0.05 * rng.standard_normal((600, 3)))
    assert score_track(rest, noisy).notes == ()
