"""Damaged inputs for the property test: a sound scenario, recording or result, and kinds of damage that draw from hypothesis.

Each kind is one function in a list; a new kind is one more entry.
"""

from __future__ import annotations

import copy
import datetime
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomli_w
from hypothesis import strategies as st

Draw = Callable[[Any], Any]

FLIGHT: dict[str, Any] = {
    "scenario": {"name": "short", "title": "short"},
    "flight": {
        "aircraft": "aerosonde",
        "rate_hz": 50.0,
        "duration_s": 3.0,
        "initial": {"lat_deg": 47.26, "lon_deg": 11.35, "alt_m": 1200.0, "speed_mps": 30.0, "heading_deg": 60.0},
        "wind": {"north_mps": 3.0, "turbulence": "light"},
        "manoeuvres": [
            {"type": "straight", "duration_s": 1.0},
            {"type": "turn", "bank_deg": 30.0, "duration_s": 1.0},
            {"type": "waypoints", "points": [{"north_m": 300.0, "east_m": 0.0}]},
        ],
    },
    "sensors": {
        "imu": {"model": "ADIS16448", "vibration": {"tones": [{"frequency_hz": 12.0, "accel_g": [0.1, 0.0, 0.0]}]}},
        "gnss": {"model": "Garmin16x", "outages": [[1.0, 2.0]], "outliers": {"count": 1, "duration_s": 0.5}},
        "mag": {"model": "ADIS16405"},
        "baro": {},
    },
    "initial": {"position_m": 3.0, "velocity_mps": 0.3, "roll_pitch_deg": 1.0, "yaw_deg": 3.0},
    "estimators": [{"name": "ins"}, {"name": "indirect-kf", "label": "kf", "params": {"gyro_bias_scale": 1.0}}],
    "monte_carlo": {
        "runs": 1,
        "seed": 1,
        "vary": ["noise", "manoeuvres"],
        "disperse": {"manoeuvres.1.bank_deg": {"normal": [30.0, 1.0]}},
    },
    "windows": [{"kind": "outages"}, {"kind": "phases"}, {"name": "mid", "start": 0.5, "end": 2.5}],
    "claims": [{"id": "c", "better": "kf", "than": "ins", "metric": "rmse_position_3d_m", "text": "better"}],
    "tables": [
        {"title": "T", "columns": ["ins", "kf"], "rows": [{"name": "n", "metric": "rmse_north_m", "paper": [1.0, 2.0]}]}
    ],
    "profiles": {"smoke": {"monte_carlo": {"runs": 1}}},
    "variants": {"rough": {"flight": {"wind": {"turbulence": "severe"}}}},
}
RECORDING: dict[str, Any] = {
    "scenario": {"name": "recorded"},
    "recording": {"format": "table", "dir": "table", "initial": {"heading": "none"}, "end_s": 2.5},
    "estimators": [{"name": "ins"}, {"name": "indirect-kf"}],
    "windows": [{"name": "mid", "start": 0.5, "end": 2.0}],
}
BASES = {"flight": FLIGHT, "recording": RECORDING}

ODD: list[Any] = [
    *(-1, 0, 1, 3, -1.0, 0.0, 0.5, 1e-9, 1e-300, 1e9, 1e300, -1e308, 2**63 - 1, -(2**63), 10**7),
    *(float("inf"), float("-inf"), float("nan"), True, False),
    *(
        "",
        " ",
        "x" * 100,
        "x" * 400,
        "y/" * 200,
        "nul\0byte",
        "²",
        "=1+1",
        "@SUM(A1)",
        "../..",
        "/",
        "a\tb\nc",
        "ins",
        "}\\input{x}",
    ),
    *([], {}, [[]], [1.0, "a"], {"a": {"b": 1}}, [{}], {"": 0}),
    *(datetime.date(2020, 1, 1), datetime.time(1, 2)),
]
"""Values that some key somewhere does not expect."""


def places(data: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in nested tables and lists, parents before children."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [found for key, value in items for found in ((*place, key), *places(value, (*place, key)))]


def parent_of(data: Any, place: tuple[Any, ...]) -> Any:
    for key in place[:-1]:
        data = data[key]
    return data


def replace_value(data: Any, place: tuple[Any, ...], draw: Draw) -> None:
    parent_of(data, place)[place[-1]] = copy.deepcopy(draw(st.sampled_from(ODD)))


def scale_number(data: Any, place: tuple[Any, ...], draw: Draw) -> None:
    value = parent_of(data, place)[place[-1]]
    if isinstance(value, int | float) and not isinstance(value, bool):
        parent_of(data, place)[place[-1]] = type(value)(value * draw(st.sampled_from([-1, 2, 100, 10**6])))


def remove(data: Any, place: tuple[Any, ...], draw: Draw) -> None:
    del parent_of(data, place)[place[-1]]


def add_key(data: Any, place: tuple[Any, ...], draw: Draw) -> None:
    value = parent_of(data, place)[place[-1]]
    if isinstance(value, dict):
        value[
            draw(st.sampled_from(["unknown", "", "a.b", "²", "label", "file", "params_file", "type", "seed", "name"]))
        ] = copy.deepcopy(draw(st.sampled_from(ODD)))


def repeat(data: Any, place: tuple[Any, ...], draw: Draw) -> None:
    value = parent_of(data, place)[place[-1]]
    if isinstance(value, list) and value:
        value.append(copy.deepcopy(value[0]))


def swap(data: Any, place: tuple[Any, ...], draw: Draw) -> None:
    """Another part of the scenario in this place."""
    other = draw(st.sampled_from(places(data)))
    parent_of(data, place)[place[-1]] = copy.deepcopy(parent_of(data, other)[other[-1]])


def nest(data: Any, place: tuple[Any, ...], draw: Draw) -> None:
    value = parent_of(data, place)[place[-1]]
    for _ in range(draw(st.sampled_from([1, 20, 40]))):
        value = [value]
    parent_of(data, place)[place[-1]] = value


DATA_DAMAGE = [replace_value, replace_value, scale_number, remove, add_key, repeat, swap, nest]


def cut_bytes(text: bytes, at: int, draw: Draw) -> bytes:
    return text[:at] + text[at + draw(st.integers(1, 40)) :]


def end_here(text: bytes, at: int, draw: Draw) -> bytes:
    return text[:at]


def insert_bytes(text: bytes, at: int, draw: Draw) -> bytes:
    odd = [
        b"\0",
        b"\xff\xfe",
        b"[" * 3000,
        b"9" * 5000,
        b"'",
        b'"""',
        b"\r",
        b"\n[flight]\n",
        b"a.a.a=1\n",
        b"{",
        "²".encode(),
    ]
    return text[:at] + draw(st.sampled_from(odd)) + text[at:]


def flip_bit(text: bytes, at: int, draw: Draw) -> bytes:
    if not text:
        return text
    at %= len(text)
    return text[:at] + bytes([text[at] ^ (1 << draw(st.integers(0, 7)))]) + text[at + 1 :]


BYTE_DAMAGE = [cut_bytes, end_here, insert_bytes, flip_bit]


@st.composite
def scenarios(draw: Draw) -> bytes:
    """The text of a scenario with one to three kinds of damage."""
    data = copy.deepcopy(BASES[draw(st.sampled_from(sorted(BASES)))])
    for _ in range(draw(st.integers(1, 3))):
        if found := places(data):
            draw(st.sampled_from(DATA_DAMAGE))(data, draw(st.sampled_from(found)), draw)
    text = tomli_w.dumps(data).encode()
    if draw(st.integers(0, 3)) == 0:
        text = draw(st.sampled_from(BYTE_DAMAGE))(text, draw(st.integers(0, len(text))), draw)
    return text


def damage_file(file: Path, draw: Draw) -> None:
    """One kind of damage to the bytes of a file."""
    content = file.read_bytes()
    file.write_bytes(draw(st.sampled_from(BYTE_DAMAGE))(content, draw(st.integers(0, len(content))), draw))


def no_file(file: Path, draw: Draw) -> None:
    file.unlink()


def empty_file(file: Path, draw: Draw) -> None:
    file.write_bytes(b"")


def folder_instead(file: Path, draw: Draw) -> None:
    file.unlink()
    file.mkdir()


def drop_column(file: Path, draw: Draw) -> None:
    _columns(file, draw, lambda row, k: row[:k] + row[k + 1 :])


def column_twice(file: Path, draw: Draw) -> None:
    _columns(file, draw, lambda row, k: [*row, row[k]])


def odd_cell(file: Path, draw: Draw) -> None:
    lines = file.read_text(errors="replace").splitlines()
    if file.suffix != ".csv" or not lines:
        return
    k = draw(st.integers(0, len(lines) - 1))
    row = lines[k].split(",")
    row[draw(st.integers(0, len(row) - 1))] = draw(
        st.sampled_from(["", "nan", "inf", "text", "1e300", "-1", "1,2", "²"])
    )
    lines[k] = ",".join(row)
    file.write_text("\n".join(lines) + "\n")


def few_rows(file: Path, draw: Draw) -> None:
    if file.suffix == ".csv":
        lines = file.read_text(errors="replace").splitlines()
        file.write_text("\n".join(lines[: draw(st.integers(0, 4))]) + "\n")


def reverse_rows(file: Path, draw: Draw) -> None:
    if file.suffix == ".csv":
        head, *rows = file.read_text(errors="replace").splitlines() or [""]
        file.write_text("\n".join([head, *reversed(rows)]) + "\n")


def _columns(file: Path, draw: Draw, change: Callable[[list[str], int], list[str]]) -> None:
    if file.suffix != ".csv":
        return
    rows = [line.split(",") for line in file.read_text(errors="replace").splitlines()]
    if rows:
        k = draw(st.integers(0, len(rows[0]) - 1))
        file.write_text("\n".join(",".join(change(row, min(k, len(row) - 1))) for row in rows) + "\n")


FILE_DAMAGE = [damage_file, no_file, empty_file, folder_instead]
TABLE_DAMAGE = [*FILE_DAMAGE, drop_column, column_twice, odd_cell, few_rows, reverse_rows]
RESULT_DAMAGE = TABLE_DAMAGE


def damage_folder(folder: Path, kinds: list[Callable[[Path, Draw], None]], draw: Draw) -> str:
    """Damage one or two files of a folder; what was done."""
    done = []
    for _ in range(draw(st.integers(1, 2))):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if files:
            kind, file = draw(st.sampled_from(kinds)), draw(st.sampled_from(files))
            kind(file, draw)
            done.append(f"{kind.__name__}({file.relative_to(folder)})")
    return ", ".join(done)


def copy_of(folder: Path, place: Path) -> Path:
    """A fresh copy of a folder at ``place``."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(folder, place)
    return place
