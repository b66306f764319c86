"""Pieces of reStructuredText."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence


def heading(text: str, line: str = "=") -> str:
    return f"{text}\n{line * len(text)}\n\n"


def table(head: Sequence[str], rows: Iterable[Sequence[object]], widths: str = "") -> str:
    """A list table; cells are reStructuredText."""
    out = [".. list-table::", "   :header-rows: 1", *([f"   :widths: {widths}"] if widths else []), ""]
    for row in (head, *rows):
        for k, cell in enumerate(row):
            lines = str(cell).split("\n") if str(cell) else [""]
            out.append(f"   {'* -' if k == 0 else '  -'} {lines[0]}".rstrip())
            out += [f"       {line}".rstrip() for line in lines[1:]]
    return "\n".join(out) + "\n\n"


def plain(text: object) -> str:
    """Text without markup as reStructuredText, double backquotes kept."""
    pieces = re.split(r"(``[^`]+``)", " ".join(str(text).split()))
    return "".join(piece if piece.startswith("``") else re.sub(r"([*`_|\\])", r"\\\1", piece) for piece in pieces)


def code(text: object) -> str:
    return f"``{text}``" if str(text) else ""


def first_paragraph(text: str | None) -> str:
    return " ".join((text or "").split("\n\n")[0].split())


def shortened(value: str) -> str:
    """A default: as code where it is a value of TOML."""
    return code(value) if value[:1] in "[{\"'-0123456789" or value in ("true", "false") else plain(value)
