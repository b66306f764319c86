"""The errors that a user can mend: each says where, what was wrong and what would be right.

The command line turns them into one message and an exit code; the Python API raises them.
"""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Iterable

LONGEST_VALUE = 80
"""Characters of a wrong value that a message repeats: about a line of a terminal, enough to find it again."""
LONGEST_LINE = 2000
LONGEST_WORD = 400
"""A word of a message may be a path, whose parts have at most 255 characters; beyond this it is an echoed value."""
MOST_LINES = 20


class TestbedError(Exception):
    """Base of every error that the bench raises on purpose. ``exit_code`` is what the command line returns."""

    __test__ = False  # the name is not a pytest class
    exit_code = 1

    def __init__(self, message: object = "") -> None:
        super().__init__(readable(str(message)))


class InputError(TestbedError):
    """Bad usage or bad input: a scenario, a file, a name, a unit. Exit code 2."""

    exit_code = 2


class MissingExtra(InputError):
    """A package of an extra is not installed. What does not ask for it by name leaves it out with a note."""


class FlightError(InputError):
    """The aircraft cannot fly the script (stall, ground, divergence, out of its envelope)."""


def shown(value: object) -> str:
    """A wrong value as a message repeats it: its repr, the middle of a long one left out."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list in a list in a list
        text = f"a {type(value).__name__} too long to show"
    return _cut(text, LONGEST_VALUE)


def readable(message: str) -> str:
    """A message that fits a screen whatever it repeats: long words, long lines and many lines are cut."""
    lines = message.splitlines() or [""]
    if len(lines) > MOST_LINES + 1:
        lines = [*lines[:MOST_LINES], f"... and {len(lines) - MOST_LINES} more"]
    words = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")
    return "\n".join(_cut(words.sub(lambda word: _cut(word[0], LONGEST_WORD), line), LONGEST_LINE) for line in lines)


def _cut(text: str, longest: int) -> str:
    """``text`` with its middle left out where it is longer than ``longest``."""
    return text if len(text) <= longest else f"{text[: longest // 2]}…{text[-(longest // 4) :]}"


OWN = "one of your own comes with --plugin FILE.py"
"""Ends a message on an estimator that nobody knows."""


def nearest(name: str, valid: Iterable[str]) -> str:
    """A hint that ends an error message: the closest valid names, or all of them when none is close."""
    names = sorted(str(entry) for entry in valid)
    if (close := closest(name, names)) is not None:
        return f"did you mean '{close}'?"
    return "valid: " + (", ".join(names) if names else "none")


def closest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name that was probably meant; None where none is close."""
    return next(iter(difflib.get_close_matches(name[:LONGEST_VALUE], sorted(valid), n=1, cutoff=0.5)), None)


def tell_user(text: str) -> None:
    """A line on stderr, at once."""
    print(text, file=sys.stderr, flush=True)
