"""The satellites that there are: the nominal GPS and Galileo constellations, and those of a RINEX navigation file.

GPS: 24 slots of the SPS Performance Standard (2001), table 3-1, and the three expandable ones of its 2008 edition, table
3.2-2. Galileo: Walker 24/3/1 of the OS reference constellation. All become rows of `testbed.gnss.orbits.FIELDS`.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.satellites import GALILEO, GPS, LETTERS, name_of
from testbed.gnss import orbits
from testbed.physics.ranging import OMEGA

Array = NDArray[np.float64]

SYSTEMS = {"gps": GPS, "galileo": GALILEO}
GPS_EPOCH = datetime.datetime(1980, 1, 6)
DAY_S = 86400.0

GPS_A = 26559.7e3
GPS_EPOCH_OF_SLOTS = datetime.datetime(1993, 7, 1)
GPS_NODE_RATE = math.radians(-4.4874e-7)
"""rad/s"""
GPS_PLANES: dict[str, tuple[float, tuple[float, ...]]] = {
    "A": (272.847, (268.126, 161.786, 11.676, 41.806)),
    "B": (332.847, (80.956, 173.336, 309.976, 204.376)),
    "C": (32.847, (111.876, 11.796, 339.666, 241.556)),
    "D": (92.847, (135.226, 265.446, 35.156, 167.356)),
    "E": (152.847, (197.046, 302.596, 66.066, 333.686)),
    "F": (212.847, (238.886, 345.226, 105.206, 135.346)),
}
"""Right ascension of each plane and arguments of latitude of its slots, degrees."""
EXPANDED = {("B", 0): (94.916, 66.356), ("D", 1): (282.676, 257.976), ("F", 1): (0.456, 334.016)}
"""Slots that two satellites may share: fore and aft."""

GALILEO_A = 29599.8e3
GALILEO_EPOCH_OF_SLOTS = datetime.datetime(2016, 11, 21)
GALILEO_NODE_RATE = math.radians(-0.02764398) / DAY_S
GALILEO_NODE, GALILEO_ARGUMENT = 317.632, 180.153


@dataclass(frozen=True)
class Sky:
    """Satellites and their ephemerides for a flight that starts at ``start`` (GPS time)."""

    start: datetime.datetime
    codes: NDArray[np.int64]
    """(S,) 100 times the system (1 GPS, 2 Galileo) plus the satellite's number."""
    ephemerides: Array
    """(S,23)"""
    klobuchar: Array
    """(8,) alpha and beta of the broadcast ionosphere."""
    tag: str = ""

    @property
    def names(self) -> list[str]:
        """G05, E12 ..."""
        return [name_of(code) for code in self.codes]

    @property
    def second_of_day(self) -> float:
        """GPS time of day at the start, s."""
        return week_seconds(self.start) % DAY_S


KLOBUCHAR = np.array([8.3819e-9, 1.4901e-8, -5.9605e-8, -5.9605e-8, 83968.0, 16384.0, -131072.0, -65536.0])
"""Broadcast on 2021-09-22, a day of low solar activity."""


def code_of(name: str) -> int:
    """Number of a satellite's name. Raises InputError for what is none."""
    systems = {letter: system for system, letter in LETTERS.items()}
    if len(name) != 3 or name[0] not in systems or not name[1:].isdigit() or not 1 <= int(name[1:]) <= 40:
        raise InputError(f"'{name}' is no satellite: G01 to G32 are GPS, E01 to E36 Galileo")
    return 100 * systems[name[0]] + int(name[1:])


def week_seconds(moment: datetime.datetime) -> float:
    """Seconds of the GPS week."""
    return (moment - GPS_EPOCH).total_seconds() % orbits.WEEK_S


def sidereal_angle(moment: datetime.datetime) -> float:
    """Greenwich mean sidereal time, rad (IAU 1982, without its quadratic term, a thousandth of a degree in a century)."""
    days = (moment - datetime.datetime(2000, 1, 1, 12)).total_seconds() / DAY_S
    return math.radians((280.46061837 + 360.98564736629 * days) % 360.0)


def nominal_sky(start: datetime.datetime, systems: Sequence[str] = ("gps",), expanded: bool = False) -> Sky:
    """The nominal constellations as they stand from ``start`` (GPS time) on; ``expanded`` gives GPS 27 satellites."""
    codes: list[int] = []
    rows: list[Array] = []
    for system in systems:
        made = _gps(start, expanded) if SYSTEMS[system] == GPS else _galileo(start)
        codes += [100 * SYSTEMS[system] + k + 1 for k in range(len(made))]
        rows += made
    return Sky(start, np.array(codes, dtype=np.int64), np.array(rows), KLOBUCHAR, "nominal " + "+".join(systems))


def _gps(start: datetime.datetime, expanded: bool) -> list[Array]:
    rows = []
    for plane, (node, arguments) in GPS_PLANES.items():
        for k, argument in enumerate(arguments):
            for u in EXPANDED.get((plane, k), (argument,)) if expanded else (argument,):
                slot = (math.radians(node), math.radians(u))
                rows.append(_circular(start, GPS_EPOCH_OF_SLOTS, slot, GPS_A, GPS_NODE_RATE))
    return rows


def _galileo(start: datetime.datetime) -> list[Array]:
    rows = []
    for plane in range(3):
        for k in range(8):
            node = math.radians(GALILEO_NODE + 120.0 * plane)
            u = math.radians(GALILEO_ARGUMENT + 45.0 * k + 15.0 * plane)
            rows.append(_circular(start, GALILEO_EPOCH_OF_SLOTS, (node, u), GALILEO_A, GALILEO_NODE_RATE))
    return rows


def _circular(
    start: datetime.datetime, epoch: datetime.datetime, slot: tuple[float, float], a: float, node_rate: float
) -> Array:
    """An ephemeris at ``start`` of a circular orbit whose node and argument of latitude held at ``epoch`` (rad)."""
    row = np.zeros(len(orbits.FIELDS))
    mu, tilt = (orbits.MU_GPS, 55.0) if a == GPS_A else (orbits.MU_GALILEO, 56.0)
    age, second = (start - epoch).total_seconds(), week_seconds(start)
    node = slot[0] + node_rate * age - sidereal_angle(start)
    row[orbits.TOE_OF_WEEK], row[orbits.SQRT_A], row[orbits.I0] = second, math.sqrt(a), math.radians(tilt)
    row[orbits.OMEGA0] = math.remainder(node + OMEGA * second, 2.0 * math.pi)
    row[orbits.M0] = math.remainder(slot[1] + math.sqrt(mu / a**3) * age, 2.0 * math.pi)
    row[orbits.OMEGA_DOT], row[orbits.MU] = node_rate, mu
    return row
