"""Allan analysis of a table of one's own: known noise comes back in every tool's units, as a catalogue entry that works."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from testbed.base.errors import InputError
from testbed.cli import commands
from testbed.sensors import catalog

ARW, VRW, RATE = 0.3, 0.05, 50.0
"""deg/√h, m/s/√h, Hz: of the made record."""
DENSITY_G, DENSITY_A = math.radians(ARW) / 60.0, VRW / 60.0


@pytest.fixture
def record(tmp_path: Path) -> Path:
    """400 s at rest in °/s and g, in the units and names of some logger, stamps in ms."""
    rng = np.random.default_rng(11)
    n = int(400 * RATE)
    frame = pd.DataFrame({"ms": np.arange(1, n + 1) * 20})
    gyro = DENSITY_G * np.sqrt(RATE) * rng.standard_normal((n, 3))
    accel = DENSITY_A * np.sqrt(RATE) * rng.standard_normal((n, 3)) + [0.0, 0.0, -9.80665]
    for i, axis in enumerate("xyz"):
        frame[f"g{axis}"], frame[f"a{axis}"] = np.degrees(gyro[:, i]), accel[:, i] / 9.80665
    frame.to_csv(tmp_path / "still.csv", index=False)
    names = {"ms": "time_ms"} | {f"g{a}": f"gyro_{a}_dps" for a in "xyz"} | {f"a{a}": f"accel_{a}_g" for a in "xyz"}
    lines = "\n".join(f'"{k}" = "{v}"' for k, v in names.items())
    (tmp_path / "map.toml").write_text(f"[columns]\n{lines}\n")
    return tmp_path / "still.csv"


def test_figures_and_the_entry_come_back(record: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """White noise of 3 x 20,000 samples is known to 1/√60,000 = 0.4 % at the shortest cluster time; 2 % are 5 sigma."""
    commands.allan(record, tmp_path / "out", "unit7", tmp_path / "map.toml")
    table = pd.read_csv(tmp_path / "out" / "allan.csv").set_index(["triad", "axis", "figure"])["fitted"]
    assert table["gyro", "all", "ARW"] == pytest.approx(ARW, rel=0.02)
    assert table["accel", "all", "VRW"] == pytest.approx(VRW, rel=0.02)
    spec = catalog.specification("imu", "unit7", {}, tmp_path / "out" / "sensors.toml")
    assert spec.gyro.white_noise == pytest.approx(DENSITY_G, rel=0.02)
    assert spec.accel.white_noise == pytest.approx(DENSITY_A, rel=0.02)
    assert spec.rate_hz == RATE
    told = capsys.readouterr().out
    for name, value in {
        "gyroscope_noise_density": DENSITY_G,
        "accelerometerCovariance": DENSITY_A**2,
        "EKF2_GYR_NOISE": DENSITY_G * 10.0,
        "gyro noise": DENSITY_G * math.sqrt(RATE),
    }.items():
        (line,) = [x for x in told.splitlines() if x.strip().startswith(name)]
        assert float(line[len(name) + 2 :].split()[0]) == pytest.approx(value, rel=0.04), name
    arw = [x for x in told.splitlines() if x.strip().startswith("arw ")]
    assert float(arw[0].split()[1]) == pytest.approx(ARW, rel=0.02)  # KF-GINS: deg/sqrt(h)
    assert float(arw[1].split()[1]) == pytest.approx(DENSITY_G, rel=0.02)  # NaveGo: rad/s/sqrt(Hz)


def test_a_random_walk_is_told_in_the_units_of_others() -> None:
    """A bias that is a Gauss-Markov process of sigma s and time T is driven by s √(2/T)."""
    from testbed.data.specs import GAUSS_MARKOV_PEAK
    from testbed.sensors.allan_export import driving
    from testbed.sensors.allan_fit import Figures

    assert driving(Figures(bias_instability=GAUSS_MARKOV_PEAK * 2e-4, correlation_time_s=50.0)) == pytest.approx(4e-5)
    assert driving(Figures(rate_random_walk=3e-6)) == 3e-6
    assert driving(Figures(white_noise=1.0)) == 0.0


def test_what_cannot_be_read_is_said(record: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"still\.csv: no column for time"):
        commands.allan(record, tmp_path / "out")
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        commands.allan(tmp_path / "none.csv", tmp_path / "out")
    assert not (tmp_path / "out").exists()
