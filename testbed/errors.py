"""The errors that a user can mend: each says where, what was wrong and what would be right.

The command line turns them into one message and an exit code; the Python API raises them.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class TestbedError(Exception):
    """Base of every error that the bench raises on purpose. ``exit_code`` is what the command line returns."""

    __test__ = False  # the name is not a pytest class
    exit_code = 1


class InputError(TestbedError):
    """Bad usage or bad input: a scenario, a file, a name, a unit. Exit code 2."""

    exit_code = 2


class FlightError(InputError):
    """The aircraft cannot fly the script (stall, ground, divergence, out of its envelope)."""


OWN = "one of your own comes with --plugin FILE.py"
"""Ends a message on an estimator that nobody knows."""


def nearest(name: str, valid: Iterable[str]) -> str:
    """A hint that ends an error message: the closest valid names, or all of them when none is close."""
    names = sorted(valid)
    if (close := closest(name, names)) is not None:
        return f"did you mean '{close}'?"
    return "valid: " + (", ".join(names) if names else "none")


def closest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name that was probably meant; None where none is close."""
    return next(iter(difflib.get_close_matches(name, sorted(valid), n=1, cutoff=0.5)), None)
