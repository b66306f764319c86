"""Speed of imports: an hour of a 200 Hz IMU as text and as .mat, other formats beside their own library's bare reading.

`import` is the whole of it: reading, plausibility, alignment. `library` reads every message of the same file and keeps its
numbers; where a format has no library, pandas reads the same text. `plausibility` is the module of checks alone.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import formats_flight
import formats_writers as writers
import numpy as np
import pandas as pd
import pytest
import ulog_writer

from testbed.data.records import GnssFixes, ImuSamples, InitialState, SensorLog
from testbed.formats import export_log, importers, plausibility
from testbed.formats.config import RecordingConfig

HOUR, SHORT = 3600.0, 120.0
"""s: of the formats with a limit in seconds, and of those with one in their library's time, which is a ratio."""
FIGURES = {"imu": {"model": "ADIS16448"}, "gnss": {"model": "Garmin16x"}}


def an_hour() -> SensorLog:
    """Level flight whose turn rate swings: 720,000 samples of an IMU and 18,000 fixes."""
    t, fixes, one = (
        np.arange(1, int(200 * HOUR) + 1) / 200.0,
        np.arange(1, int(5 * HOUR)) / 5.0,
        np.array([1.0, 0, 0, 0]),
    )
    initial = InitialState(0.0, 0.8, 0.1, 500.0, np.zeros(3), one, np.zeros(3), np.zeros(3), np.ones(15))
    zero = np.zeros((len(fixes), 3))
    std = np.tile([1.5, 1.5, 2.5, 0.05, 0.05, 0.05], (len(fixes), 1))
    gnss = GnssFixes(fixes, fixes, fixes, fixes, zero, formats_flight.GNSS, (), std)
    empty = ImuSamples(t, np.zeros((len(t), 3)), np.zeros((len(t), 3)), formats_flight.IMU)
    return formats_flight.swinging_turns(SensorLog(empty, initial, gnss, name="hour"))


def table(folder: Path, kind: str) -> dict[str, Any]:
    export_log(an_hour(), folder, kind)
    (folder / "log.json").unlink()
    return {"format": "table"} | FIGURES


def navego(folder: Path) -> dict[str, Any]:
    export_log(an_hour(), folder, "navego")
    return {"format": "navego"}


def kfgins(folder: Path) -> dict[str, Any]:
    log = an_hour()
    imu, gnss = log.imu, log.gnss
    np.savetxt(folder / "imu.txt", np.column_stack([imu.t, imu.gyro / 200.0, imu.accel / 200.0]), fmt="%.12g")
    place = [gnss.t, np.degrees(gnss.lat), np.degrees(gnss.lon), gnss.h, gnss.std[:, :3]]
    np.savetxt(folder / "gnss.txt", np.column_stack(place), fmt="%.12g")
    return {"format": "kfgins", "files": {"imu": "imu.txt", "gnss": "gnss.txt"}, "imu": FIGURES["imu"]}


def short_flight() -> tuple[Any, SensorLog]:
    trajectory = formats_flight.make_trajectory(SHORT)
    return trajectory, formats_flight.make_log(trajectory)


def ulog(folder: Path) -> dict[str, Any]:
    ulog_writer.write(folder / "x.ulg", formats_flight.ulog_topics(*short_flight()))
    return {"format": "ulog"}


def ardupilot(folder: Path) -> dict[str, Any]:
    writers.write_ardupilot(folder / "x.bin", writers.ardupilot_messages(*short_flight()))
    return {"format": "ardupilot"}


def bag(folder: Path, kind: str) -> dict[str, Any]:
    name = "x.bag" if kind == "ros1" else "x"
    writers.write_bag(folder / name, writers.bag_messages(*short_flight()), kind)
    return {"format": "rosbag", "files": {"bag": name}, "imu": FIGURES["imu"]}


def receiver(folder: Path, kind: str) -> dict[str, Any]:
    _, log = short_flight()
    writers.table_of_imu(log, folder, writers.START.timestamp())
    content = writers.nmea_sentences(log) if kind == "nmea" else writers.ubx_messages(log)
    (folder / f"x.{kind}").write_bytes(b"".join(content))
    return {"format": kind, "imu": FIGURES["imu"]}


def data_set(folder: Path, kind: str) -> dict[str, Any]:
    write = writers.write_euroc if kind == "euroc" else writers.write_kitti
    write(folder, *short_flight())
    return {"format": kind, "imu": FIGURES["imu"], "initial": {"attitude": "reference"}}


def read_ulog(folder: Path) -> None:
    from pyulog import ULog

    ULog(str(folder / "x.ulg"))


def read_ardupilot(folder: Path) -> None:
    from pymavlink.DFReader import DFReader_binary

    log = DFReader_binary(str(folder / "x.bin"))
    while (message := log.recv_msg()) is not None:
        message.to_dict()


def read_bag(folder: Path) -> None:
    from rosbags.highlevel import AnyReader

    with AnyReader([next(folder.glob("x*"))]) as reader:
        for connection, _, content in reader.messages():
            reader.deserialize(content, connection.msgtype)


def read_receiver(folder: Path) -> None:
    """The sentences or messages, and the IMU's table as pandas reads it."""
    from pynmeagps import NMEAReader
    from pyubx2 import UBXReader

    pd.read_csv(folder / "imu.csv")
    path = next(folder.glob("x.*"))
    with path.open("rb") as stream:
        for _ in NMEAReader(stream) if path.suffix == ".nmea" else UBXReader(stream):
            pass


def read_euroc(folder: Path) -> None:
    for path in folder.rglob("data.csv"):
        pd.read_csv(path)


def read_kitti(folder: Path) -> None:
    """As the data set's devkits do: a file at a time."""
    for path in sorted((folder / "oxts" / "data").iterdir()):
        np.loadtxt(path)


HOURS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "table-csv": lambda folder: table(folder, "csv"),
    "table-parquet": lambda folder: table(folder, "parquet"),
    "navego": navego,
    "kfgins": kfgins,
}
OTHERS: dict[str, tuple[Callable[[Path], dict[str, Any]], Callable[[Path], None]]] = {
    "ulog": (ulog, read_ulog),
    "ardupilot": (ardupilot, read_ardupilot),
    **{kind: (lambda folder, kind=kind: bag(folder, kind), read_bag) for kind in ("ros1", "sqlite3", "mcap")},
    **{kind: (lambda folder, kind=kind: receiver(folder, kind), read_receiver) for kind in ("nmea", "ubx")},
    "euroc": (lambda folder: data_set(folder, "euroc"), read_euroc),
    "kitti": (lambda folder: data_set(folder, "kitti"), read_kitti),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Callable[[str], tuple[Path, RecordingConfig]]:
    """Each recording once: its folder and its table ``[recording]``."""
    made: dict[str, tuple[Path, RecordingConfig]] = {}

    def find(name: str) -> tuple[Path, RecordingConfig]:
        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            options = (HOURS[name] if name in HOURS else OTHERS[name][0])(folder)
            made[name] = folder, RecordingConfig(dir=str(folder), **options)
            importers.load(made[name][1], Path())  # what is compiled and imported once
        return made[name]

    return find


@pytest.mark.benchmark(group="import: 1 h at 200 Hz")
@pytest.mark.parametrize("name", HOURS)
def test_import_of_an_hour(benchmark, written, name):
    config = written(name)[1]
    benchmark.extra_info["flight_s"] = HOUR
    benchmark(importers.load, config, Path())


@pytest.mark.benchmark(group="import: 1 h at 200 Hz")
@pytest.mark.parametrize("name", HOURS)
def test_plausibility_of_an_hour(benchmark, written, name):
    checked(benchmark, written(name)[1])


@pytest.mark.benchmark(group="import: 120 s at 100 Hz")
@pytest.mark.parametrize("name", OTHERS)
def test_import(benchmark, written, name):
    config = written(name)[1]
    benchmark.extra_info["flight_s"] = SHORT
    benchmark(importers.load, config, Path())


@pytest.mark.benchmark(group="import: 120 s at 100 Hz")
@pytest.mark.parametrize("name", OTHERS)
def test_library(benchmark, written, name):
    benchmark(OTHERS[name][1], written(name)[0])


@pytest.mark.benchmark(group="import: 120 s at 100 Hz")
@pytest.mark.parametrize("name", OTHERS)
def test_plausibility(benchmark, written, name):
    checked(benchmark, written(name)[1])


def checked(benchmark, config: RecordingConfig) -> None:
    """The checks on what the reader found, each time anew, as they drop what they must."""
    import copy
    import importlib

    reader = importlib.import_module(importers.READERS[config.format])
    raw = reader.read(config, Path())
    importers._specify(config, Path(), raw, "")
    benchmark.pedantic(plausibility.check, setup=lambda: ((copy.copy(raw),), {}), rounds=10)
