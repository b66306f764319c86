"""Damaged copies of small recordings of every format: a message or a right start, never another error, never a wrong one."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import formats_flight
import formats_writers
import numpy as np
import pytest
import ulog_writer
from scipy.io import savemat
from test_formats_broad import FIGURES, made_trial
from test_formats_rtklib import HEAD
from test_formats_text import GIVEN, kfgins

from testbed.base.errors import InputError
from testbed.formats import export_log, import_log
from testbed.formats.recording import Recording
from testbed.physics.rotations import attitude_errors

COPIES = int(os.environ.get("TESTBED_DAMAGED_COPIES", "8"))
"""Of each format; 500 of each take twelve minutes."""


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


def write_ulog(folder: Path) -> Callable[[], Recording]:
    trajectory = formats_flight.make_trajectory(10.0)
    topics = formats_flight.ulog_topics(trajectory, formats_flight.make_log(trajectory))
    ulog_writer.write(folder / "x.ulg", topics)
    return lambda: import_log("ulog", folder)


def write_ardupilot(folder: Path) -> Callable[[], Recording]:
    trajectory = formats_flight.make_trajectory(10.0)
    messages = formats_writers.ardupilot_messages(trajectory, formats_flight.make_log(trajectory))
    formats_writers.write_ardupilot(folder / "x.bin", messages)
    return lambda: import_log("ardupilot", folder)


def write_bag(kind: str, folder: Path) -> Callable[[], Recording]:
    trajectory = formats_flight.make_trajectory(5.0)
    messages = formats_writers.bag_messages(trajectory, formats_flight.make_log(trajectory))
    place = folder / ("x.bag" if kind == "ros1" else "bag")
    formats_writers.write_bag(place, messages, kind)
    return lambda: import_log("rosbag", place if kind != "ros1" else folder, imu=GIVEN["imu"])


def write_receiver(kind: str, folder: Path) -> Callable[[], Recording]:
    log = formats_flight.make_log(formats_flight.make_trajectory(10.0))
    formats_writers.table_of_imu(log, folder, formats_writers.START.timestamp())
    messages = formats_writers.nmea_sentences(log) if kind == "nmea" else formats_writers.ubx_messages(log)
    (folder / f"x.{kind}").write_bytes(b"".join(messages))
    return lambda: import_log(kind, folder, imu=GIVEN["imu"])


def write_data_set(kind: str, folder: Path) -> Callable[[], Recording]:
    trajectory = formats_flight.make_trajectory(3.0)
    write = formats_writers.write_euroc if kind == "euroc" else formats_writers.write_kitti
    write(folder, trajectory, formats_flight.make_log(trajectory))
    return lambda: import_log(kind, folder, imu=GIVEN["imu"], initial={"attitude": "reference"})


WRITERS: dict[str, Callable[[Path], Callable[[], Recording]]] = {
    "table": write_table,
    "navego": write_navego,
    "kfgins": write_kfgins,
    "rtklib": write_rtklib,
    "broad": write_broad,
    "ulog": write_ulog,
    "ardupilot": write_ardupilot,
    **{kind: partial(write_bag, kind) for kind in ("ros1", "sqlite3", "mcap")},
    **{kind: partial(write_receiver, kind) for kind in ("nmea", "ubx")},
    **{kind: partial(write_data_set, kind) for kind in ("euroc", "kitti")},
}
TEXT = {".csv", ".txt", ".pos", ".nmea", ".yaml"}


def damage(path: Path, content: bytes, rng: np.random.Generator) -> bytes:
    """Cut, bytes flipped, rows swapped, or a NaN: a word of a text, a float or a double of anything else."""
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
    elif path.suffix not in TEXT:
        nan = struct.pack(("<f", "<d")[int(rng.integers(0, 2))], np.nan)
        place = int(rng.integers(0, max(1, len(content) - len(nan))))
        return content[:place] + nan + content[place + len(nan) :]
    else:
        mark = b"," if b"," in lines[a] else b" "
        words = lines[a].split(mark)
        words[int(rng.integers(0, len(words)))] = b"nan"
        lines[a] = mark.join(words)
    return b"\n".join(lines)


def without_numbers(notes: Sequence[str]) -> set[str]:
    """So that a sentence which the whole recording has too, with another figure, excuses nothing."""
    return {re.sub(r"[-+.\d]+", "#", note) for note in notes}


@pytest.mark.parametrize("format", WRITERS)
def test_damaged_copies_are_refused_or_start_right(format: str, tmp_path: Path) -> None:
    """The start of what is read: within 5° of roll and pitch, 15° of heading, or three of its own sigmas (few fixes that are
    left say little), or with words that say what was found."""
    read = WRITERS[format](tmp_path)
    whole = read()
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    if format == "kitti":  # one of hundreds of files is always the one of the times
        files = [tmp_path / "oxts" / "timestamps.txt", *files[:3]]
    rng = np.random.default_rng(20)
    for _ in range(COPIES):
        path = files[int(rng.integers(0, len(files)))]
        content = path.read_bytes()
        path.write_bytes(damage(path, content, rng))
        try:
            recording = read()
        except InputError:
            continue
        finally:
            path.write_bytes(content)
        error = np.abs(np.degrees(attitude_errors(recording.log.initial.q_nb[None], whole.log.initial.q_nb[None])[0]))
        new = without_numbers(recording.notes) - without_numbers(whole.notes)
        allowed = np.maximum([5.0, 5.0, 15.0], 3.0 * np.degrees(recording.log.initial.std[6:9]))
        assert new or (error < allowed).all(), (path.name, error, allowed)
        assert np.isfinite(recording.log.initial.std).all()
