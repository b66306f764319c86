"""A league of one small track: a car that rolls north at 20 m/s with a receiver that errs by nothing, so that every error of an
answer is the entry's own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from testbed.data import registry
from testbed.league import run, suite

TRACK = """
[scenario]
name = "roll"
title = "A car that rolls north"
[flight]
type = "drive"
rate_hz = 20.0
initial = { lat_deg = 45.0, lon_deg = 5.0, alt_m = 100.0, speed_mps = 20.0, heading_deg = 0.0 }
manoeuvres = [ { type = "straight", duration_s = 60.0 } ]
[sensors.imu]
model = "ADIS16448"
[sensors.gnss]
model = "ideal"
rate_hz = 5.0
[[estimators]]
name = "ins"
[monte_carlo]
divergence_position_m = 1000.0
[extra.league]
class = "position"
metric = "rmse_position_3d_m"
length_s = 60.0
why = "Nothing."
"""
KNOWN = '''
"""Fixes without error carried from one to the next, and an error of a known size laid upon them."""
import numpy as np
from testbed import NavSolution
from testbed.data.records import POSITION_STATES

class Known:
    name = "known"
    def __init__(self, offset_m=0.0, sigma_m=0.0, told_m=0.0, fails_at=-1):
        self.offset_m, self.sigma_m, self.told_m, self.fails_at = offset_m, sigma_m, told_m, fails_at
    def run(self, log):
        if log.run == self.fails_at:
            raise RuntimeError("as asked")
        t, fixes = log.imu.t, log.gnss
        lat, lon, h = (np.interp(t, fixes.t, x) for x in (fixes.lat, fixes.lon, fixes.h))
        early = t < fixes.t[0]
        lat[early] = fixes.lat[0] + (t[early] - fixes.t[0]) * fixes.v_n[0, 0] / 6367381.8
        late = t > fixes.t[-1]
        lat[late] = fixes.lat[-1] + (t[late] - fixes.t[-1]) * fixes.v_n[-1, 0] / 6367381.8
        seed = (int(abs(log.imu.gyro[5, 0]) * 1e12) + int(100 * self.sigma_m)) % 2**32
        noise = self.sigma_m * np.random.default_rng(seed).standard_normal((len(t), 3))
        north, east = 6367381.8 + 100.0, (6388838.3 + 100.0) * np.cos(np.radians(45.0))
        out = NavSolution(
            t, lat + (self.offset_m + noise[:, 0]) / north, lon + noise[:, 1] / east, h - noise[:, 2],
            np.zeros((len(t), 3)), np.tile(log.initial.q_nb, (len(t), 1)),
            std=np.full((len(t), 3), self.told_m) if self.told_m else None, states=POSITION_STATES,
        )
        return out
'''
ANSWERS = """
import math, sys
from pathlib import Path
for place in sorted(Path(sys.argv[1]).iterdir()):
    rows = [row.split(",") for row in (place / "gnss.csv").read_text().splitlines()]
    at = [rows[0].index(name) for name in ("time_s", "lat_deg", "lon_deg", "alt_m")]
    out = [[float(row[k]) for k in at] for row in rows[1:]]
    out = [[t, lat + math.degrees(float(sys.argv[3]) / (6367381.8 + 100.0)), lon, alt] for t, lat, lon, alt in out]
    text = ["time_s,lat_deg,lon_deg,alt_m", *(",".join(map(repr, row)) for row in out)]
    Path(sys.argv[2], place.name + ".csv").write_text("\\n".join(text) + "\\n")
"""
"""A program that answers with the fixes, so and so many metres further north."""
ENTRY = """
name = "{name}"
version = "1"
source = "a test"
licence = "MIT"
division = "{division}"
class = "position"
"""


def entry(place: Path, name: str, how: str, division: str = "closed", **files: str) -> Path:
    """A folder of an entry: ``how`` is the rest of its TOML, ``files`` name (``_`` for the point) to text."""
    folder = place / name
    folder.mkdir(parents=True)
    (folder / "entry.toml").write_text(ENTRY.format(name=name, division=division) + how)
    for file, text in files.items():
        (folder / file.replace("_", ".")).write_text(text)
    return folder


def known(place: Path, name: str, **params: float) -> Path:
    """An entry whose error is known."""
    told = ", ".join(f"{key} = {value}" for key, value in params.items())
    how = f'[plugin]\nfile = "known.py"\nparams = {{ {told} }}\n'
    return entry(place, name, how, known_py=KNOWN)


def program(place: Path, name: str, offset_m: float) -> Path:
    """An entry by files whose error is known; it starts in a tenth of the time of a child with compiled code."""
    how = f'[answers]\ncommand = ["python", "solve.py", "{{log}}", "{{out}}", "{offset_m}"]\n'
    return entry(place, name, how, solve_py=ANSWERS)


def use(patch: pytest.MonkeyPatch, place: Path, seeds: int = 6) -> None:
    """Let the league be this track alone, with so many runs of each row and no shipped rows.

    The reference is `Known`, which every plug-in of these tests holds: it needs no compiled code, whose loading is what a child of
    a test would spend its time on.
    """
    file = place / "roll.toml"
    file.write_text(TRACK)
    patch.setattr(suite, "TRACKS", ("roll",))
    patch.setattr(suite, "track_files", lambda: {"roll": file})
    patch.setattr(run, "shipped_entries", list)
    patch.setattr("testbed.league.speeds.SEEDS", {"fast": seeds, "slow": 2})
    patch.setitem(suite.REFERENCE, "position", "known")
    patch.setattr(registry, "_plugins", {})
    (place / "known.py").write_text(KNOWN)
    registry.load_plugin(place / "known.py")


def table(out: Path, division: str = "closed") -> dict[str, dict]:
    """Entry -> its standing on the track."""
    data = json.loads((out / "league.json").read_text())
    found = next(t for t in data["tables"] if t["division"] == division)
    return {standing["entry"]: standing for standing in found["tracks"]["roll"]}
