"""RTKLIB's .pos: the receiver's own file of a real drive, and small ones written after the manual."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pymap3d
import pytest

from testbed.base.errors import InputError
from testbed.formats.rtklib import read_pos

DRIVE = Path(__file__).resolve().parents[3] / "shared" / "data" / "drive" / "gnss_1934_sf.pos"
HEAD = "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
UNIX_OF_2025_07_08 = 1751932800


def row(seconds: float, q: int = 1) -> str:
    return f"2025/07/08 00:00:{seconds:06.3f}   45.000000100  -7.500000000  123.4560  {q}  12  0.0100  0.0200  0.0300  0.0 0.0 0.0 0.00 9.9"


def write(path: Path, *lines: str) -> Path:
    path.write_text("% program   : RTKPOST ver.2.4.3\n%\n" + "\n".join(lines) + "\n")
    return path


def test_a_file_after_the_manual(tmp_path: Path) -> None:
    path = write(tmp_path / "a.pos", HEAD, row(1.0), row(1.2), row(1.4, q=0), row(1.6, q=5))
    fixes, position_only, notes = read_pos(path, UNIX_OF_2025_07_08)
    assert position_only
    assert fixes.t == pytest.approx([1.0 - 18.0, 1.2 - 18.0, 1.6 - 18.0], abs=1e-9)
    assert np.degrees(fixes.lat[0]) == pytest.approx(45.0000001, abs=1e-12)
    assert fixes.h[0] == 123.456
    assert fixes.std[0, :3] == pytest.approx([0.01, 0.02, 0.03])
    assert any("1 rows without a solution" in note for note in notes)
    assert any("2 with Q 1, 1 with Q 5" in note for note in notes)


def test_week_and_seconds_in_ecef_are_the_same_place(tmp_path: Path) -> None:
    """GPS week 2374 begins on 2025-07-06; pymap3d makes the coordinates."""
    x, y, z = pymap3d.geodetic2ecef(45.0, -7.5, 100.0)
    head = "%  UTC   x-ecef(m)  y-ecef(m)  z-ecef(m)  Q  ns  sdx(m)  sdy(m)  sdz(m)  vx"
    lines = [f"2374 {172800.0 + k:.3f} {x:.5f} {y:.5f} {z:.5f} 2 9 0.1 0.1 0.1 0" for k in range(3)]
    fixes, _, _ = read_pos(write(tmp_path / "x.pos", head, *lines), UNIX_OF_2025_07_08)
    assert fixes.t == pytest.approx([0.0, 1.0, 2.0], abs=1e-9)
    assert np.degrees([fixes.lat[0], fixes.lon[0]]) == pytest.approx([45.0, -7.5], abs=1e-9)
    assert fixes.h[0] == pytest.approx(100.0, abs=1e-4)
    assert fixes.std[0, :3] == pytest.approx([0.1, 0.1, 0.1])  # equal along all axes, whatever their direction


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([row(1.0)], "no header line"),
        ([HEAD], "no rows below"),
        ([HEAD, row(1.0), row(1.2)[:60]], "row 1 has"),
        ([HEAD, row(1.0), row(0.5)], "time must increase"),
        ([HEAD, row(1.0).replace("45.000000100", "145.00000010")], "outside ±90°"),
        ([HEAD, row(1.0).replace("0.0100", "fine")], "sdn(m) is 'fine' at row 0"),
        ([HEAD, row(1.0).replace("0.0100", "nan")], "not a finite number"),
        ([HEAD, row(1.0, q=0)], "no row with a solution"),
        (
            [
                HEAD.replace("latitude(deg) longitude(deg)  height(m)", "e-baseline(m) n-baseline(m) u-baseline(m)"),
                row(1.0),
            ],
            "decimal degrees",
        ),
    ],
)
def test_damaged_files_are_refused(lines: list[str], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.pos") as caught:
        read_pos(write(tmp_path / "a.pos", *lines))
    assert words in str(caught.value)


def test_any_damaged_byte_is_refused_or_read(tmp_path: Path) -> None:
    content = bytearray(write(tmp_path / "a.pos", HEAD, *(row(1.0 + 0.2 * k) for k in range(20))).read_bytes())
    rng = np.random.default_rng(2)
    for place in rng.integers(0, len(content), 200):
        damaged = content.copy()
        damaged[place] ^= int(rng.integers(1, 256))
        (tmp_path / "b.pos").write_bytes(damaged)
        try:
            fixes, _, _ = read_pos(tmp_path / "b.pos")
        except InputError:
            continue
        assert np.isfinite(fixes.lat).all()


@pytest.mark.skipif(not DRIVE.is_file(), reason="the recorded drive is not here")
def test_velocities_of_a_real_file_are_those_of_its_positions() -> None:
    """Doppler velocity, up turned to down, against the differences of fixed positions over a second: 0.2 m/s of curvature."""
    fixes, position_only, _ = read_pos(DRIVE)
    assert not position_only
    span = (fixes.t[4:] - fixes.t[:-4])[:, None]
    place = np.column_stack(
        [fixes.lat * 6.362e6, fixes.lon * 6.388e6 * np.cos(fixes.lat[0]), -fixes.h]
    )  # radii at 40° N, 1600 m
    moved = (place[4:] - place[:-4]) / span
    assert np.sqrt(np.mean((moved - fixes.v_n[2:-2]) ** 2)) < 0.3
