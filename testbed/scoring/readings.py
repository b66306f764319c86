"""One claim under several readings of what its source leaves open: does it hold in all, in none, or does it hang on one thing?

A reading's verdict is that of `testbed.scoring.verdicts` in the reading's own Monte Carlo. "Holds" means *reproduced*; all other
verdicts that decide something are "fails" (*direction reproduced* too: the figure is not reached); *not tested*, *undecided*
and *depends on runaways* are open, and a claim that has nothing else gets their name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from testbed.scoring.verdicts import LESS, NOT_TESTED, REPRODUCED, RUNAWAYS, UNDECIDED

if TYPE_CHECKING:
    from testbed.scoring.claims import ReadingConfig

HOLDS, FAILS, INCONSISTENT = "holds", "fails", "source inconsistent"
OPEN = (NOT_TESTED, UNDECIDED, RUNAWAYS)


@dataclass(frozen=True)
class Standing:
    """Where a claim stands: its class ``word``, and in a ``sentence`` under which readings it holds and fails."""

    word: str
    sentence: str


def standing(readings: Sequence[ReadingConfig], verdicts: Mapping[str, str], contradiction: str = "") -> Standing:
    """The class of a claim. ``verdicts`` maps a reading's name to its verdict; ``contradiction`` quotes the source against itself."""
    holds = [reading for reading in readings if verdicts[reading.name] == REPRODUCED]
    unclear = [reading for reading in readings if verdicts[reading.name] in OPEN]
    fails = [reading for reading in readings if reading not in holds and reading not in unclear]
    less = [reading for reading in fails if verdicts[reading.name] == LESS]
    parts = [("holds under", holds), ("holds in direction, not in size, under", less)]
    parts += [("fails under", [r for r in fails if r not in less]), ("is open under", unclear)]
    sentence = "; ".join(f"{words} {_names(part, len(readings))}" for words, part in parts if part)
    if not holds and not fails:
        word = next((word for word in (RUNAWAYS, UNDECIDED) if word in verdicts.values()), NOT_TESTED)
    elif not holds or not fails:
        word = HOLDS if holds else FAILS
    else:
        separating = _separating(holds, fails)
        word = f"depends on {' or '.join(map(' and '.join, separating)) or 'the reading'}"
        for names in separating:
            sentence += f"; {' and '.join(names)}: {_values(names, holds)} where it holds, {_values(names, fails)} where it fails"
    if contradiction:
        return Standing(INCONSISTENT, f"{contradiction} As tested here it {word}: it {sentence}.")
    return Standing(word, f"It {sentence}." if sentence else "")


def _separating(holds: Sequence[ReadingConfig], fails: Sequence[ReadingConfig]) -> list[tuple[str, ...]]:
    """The fewest conditions that tell the readings where a claim holds from those where it fails; none where all do not.

    Several where either alone does, so that the readings tried cannot tell which; with several names where it takes all of them.
    """
    conditions = list(dict.fromkeys(name for reading in (*holds, *fails) for name in reading.conditions))
    for size in range(1, len(conditions) + 1):
        found = []
        for names in combinations(conditions, size):
            one, other = ({tuple(r.conditions.get(name) for name in names) for r in part} for part in (holds, fails))
            if not one & other:
                found.append(names)
        if found:
            return found
    return []


def _values(names: tuple[str, ...], readings: Sequence[ReadingConfig]) -> str:
    """What the conditions are in these readings."""
    told = (" and ".join(r.conditions.get(name, "–") for name in names) for r in readings)
    return ", ".join(f"“{value}”" for value in dict.fromkeys(told))


def _names(readings: Sequence[ReadingConfig], total: int) -> str:
    if len(readings) == total > 1:
        return "every reading"
    return ", ".join(f"“{reading.name}”" for reading in readings)
