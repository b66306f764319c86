"""Damaged copies of small recordings of every format: a message or a right start, never another error, never a wrong one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import formats_flight
import numpy as np
import pytest
from scipy.io import savemat
from test_formats_broad import FIGURES, made_trial
from test_formats_rtklib import HEAD
from test_formats_text import GIVEN, kfgins

from testbed.base.errors import InputError
from testbed.formats import export_log, import_log
from testbed.formats.recording import Recording
from testbed.physics.rotations import attitude_errors

COPIES = int(os.environ.get("TESTBED_DAMAGED_COPIES", "25"))
"""Of each format; 500 in all take two minutes."""


def write_table(folder: Path) -> Callable[[], Recording]:
    trajectory = formats_flight.make_trajectory(10.0)
    export_log(formats_flight.make_log(trajectory), folder, "csv")
    for name in ("log.json", "mag.csv", "baro.csv"):
        (folder / name).unlink()
    return lambda: import_log("table", folder, **GIVEN)


def write_navego(folder: Path) -> Callable[[], Recording]:
    export_log(formats_flight.make_log(formats_flight.make_trajectory(10.0)), folder, "navego")
    return lambda: import_log("navego", folder)


def write_kfgins(folder: Path) -> Callable[[], Recording]:
    trajectory = formats_flight.make_trajectory(10.0)
    files = kfgins(trajectory, formats_flight.make_log(trajectory), folder, 1000.0)
    (folder / files.pop("reference")).unlink()
    return lambda: import_log("kfgins", folder, files=files, imu={"model": "ADIS16448"})


def write_rtklib(folder: Path) -> Callable[[], Recording]:
    write_table(folder)
    log = formats_flight.make_log(formats_flight.make_trajectory(10.0))
    (folder / "gnss.csv").unlink()
    head = HEAD + "  vn(m/s)   ve(m/s)   vu(m/s)      sdvn     sdve     sdvu    sdvne    sdveu    sdvun"
    rows = []
    for k in range(len(log.gnss.t)):
        g = log.gnss
        place = f"{np.degrees(g.lat[k]):.9f} {np.degrees(g.lon[k]):.9f} {g.h[k]:.4f} 5 9 1.5 1.5 2.5 0 0 0 0 0"
        v = f"{g.v_n[k, 0]:.4f} {g.v_n[k, 1]:.4f} {-g.v_n[k, 2]:.4f} 0.05 0.05 0.05 0 0 0"
        rows.append(f"1970/01/01 00:00:{g.t[k] + 18.0:06.3f} {place} {v}")
    (folder / "x.pos").write_text("\n".join([head, *rows]) + "\n")
    return lambda: import_log("rtklib", folder, imu=GIVEN["imu"])


def write_broad(folder: Path) -> Callable[[], Recording]:
    trial = made_trial()
    savemat(folder / "trial.mat", {k: v[:400] if len(v) > 1 else v for k, v in trial.items()})
    return lambda: import_log("broad", folder, imu=FIGURES)


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    kind = rng.integers(0, 4)
    if kind == 0:
        return content[: int(rng.integers(0, len(content)))]
    if kind == 1:
        changed = bytearray(content)
        for place in rng.integers(0, len(content), 3):
            changed[place] ^= int(rng.integers(1, 256))
        return bytes(changed)
    lines = content.split(b"\n")
    a, b = (int(k) for k in rng.integers(0, len(lines), 2))
    if kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    else:
        mark = b"," if b"," in lines[a] else b" "
        words = lines[a].split(mark)
        words[int(rng.integers(0, len(words)))] = b"nan"
        lines[a] = mark.join(words)
    return b"\n".join(lines)


@pytest.mark.parametrize("write", [write_table, write_navego, write_kfgins, write_rtklib, write_broad])
def test_damaged_copies_are_refused_or_start_right(write, tmp_path: Path) -> None:
    """The start of what is read: within 5° of roll and pitch, 15° of heading, or three of its own sigmas (few fixes that are
    left say little), or with words that say what was found."""
    read = write(tmp_path)
    whole = read()
    files = sorted(tmp_path.iterdir())
    rng = np.random.default_rng(20)
    for _ in range(COPIES):
        path = files[int(rng.integers(0, len(files)))]
        content = path.read_bytes()
        path.write_bytes(damage(content, rng))
        try:
            recording = read()
        except InputError:
            continue
        finally:
            path.write_bytes(content)
        error = np.abs(np.degrees(attitude_errors(recording.log.initial.q_nb[None], whole.log.initial.q_nb[None])[0]))
        new = set(recording.notes) - set(whole.notes)
        allowed = np.maximum([5.0, 5.0, 15.0], 3.0 * np.degrees(recording.log.initial.std[6:9]))
        assert new or (error < allowed).all(), (path.name, error, allowed)
        assert np.isfinite(recording.log.initial.std).all()
