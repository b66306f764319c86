"""Names of satellites: a system and a number, as a code or as RINEX writes it."""

from __future__ import annotations

GPS, GALILEO = 1, 2
LETTERS = {GPS: "G", GALILEO: "E"}


def name_of(code: float) -> str:
    """Name of a satellite, such as G05, of its code: 100 times the system (1 GPS, 2 Galileo) plus its number."""
    return f"{LETTERS[int(code) // 100]}{int(code) % 100:02d}"
