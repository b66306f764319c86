"""How the bench's records show themselves in an interpreter and a notebook: a few lines in place of all their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from html import escape
from typing import Any

import numpy as np

LONGEST = 70
"""Characters of a value in a line."""


class Shown:
    """Base of a dataclass (with ``repr=False``) that shows itself in short."""

    def __repr__(self) -> str:
        head, rows = self._told()
        width = max((len(name) for name, _ in rows), default=0)
        return "\n".join([head, *(f"  {name:{width}s}  {text}" for name, text in rows)])

    def _repr_html_(self) -> str:
        head, rows = self._told()
        cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in rows)
        return f"<table><caption>{escape(head)}</caption>{cells}</table>"

    def _told(self) -> tuple[str, list[tuple[str, str]]]:
        """Headline and (name, value in words) of what is not empty."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]  # a dataclass
        name, t = values.pop("name", ""), values.get("t")
        head = f"{type(self).__name__} {name}".strip()
        if isinstance(t, np.ndarray):
            head += f": {_span(values.pop('t'))}"
        return head, [(key, text) for key, value in values.items() if (text := in_words(value))]


def _span(t: np.ndarray[Any, Any]) -> str:
    if len(t) < 2:
        return f"{len(t)} rows"
    step = float(np.median(np.diff(t)))
    rate = f", {1.0 / step:.4g} Hz" if step > 0.0 else ""
    return f"{len(t)} rows, {t[0]:.6g} to {t[-1]:.6g} s{rate}"


def in_words(value: Any) -> str:
    """A value in at most `LONGEST` characters: numbers of an array by shape and range; empty for what says nothing."""
    if value is None or value is False or (isinstance(value, str | tuple | Mapping) and not value):
        return ""
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, Shown):
        return repr(value).splitlines()[0]
    if isinstance(value, Mapping):
        text = ", ".join(map(str, value))
    elif isinstance(value, tuple):
        if not any(value):  # a lever arm of nothing
            return ""
        text = ", ".join(str(getattr(item, "name", item)) for item in value)
        text = f"{len(value)}: {text}"
    else:
        text = str(getattr(value, "name", value))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _array(values: np.ndarray[Any, Any]) -> str:
    if values.size <= 4:
        return np.array2string(values, precision=6)
    shape = "x".join(map(str, values.shape))
    if not np.issubdtype(values.dtype, np.number):
        return shape
    known = values[np.isfinite(values)]
    return f"{shape}, {known.min():.6g} to {known.max():.6g}" if len(known) else f"{shape}, no number"
