"""Tables as CSV whose texts stay texts: a spreadsheet takes a cell that begins with = + - @ for a formula and computes it.

Such a text gets an apostrophe in front, which spreadsheets know as the mark of a text, and loses it when it is read back
here. Numbers are left alone.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

_FORMULA = re.compile(r"'*[=+\-@\t\r]")
"""What would be a formula; with apostrophes of its own in front it is marked too, so that reading back is exact."""


def csv_text(frame: pd.DataFrame, **options: Any) -> str:
    """The table as CSV without its index; ``options`` are those of `pandas.DataFrame.to_csv`."""
    texts = {name: frame[name].map(_marked) for name in frame.columns if _is_text(frame[name].dtype)}
    text: str = frame.assign(**texts).rename(columns=_marked).to_csv(index=False, **options)
    return text


def read_csv(path: Path, **options: Any) -> pd.DataFrame:
    """A table that `csv_text` made; ``options`` are those of `pandas.read_csv`."""
    import pandas as pd

    frame = pd.read_csv(path, **options)
    for name in frame.columns:
        if _is_text(frame[name].dtype):
            frame[name] = frame[name].map(_unmarked)
    return frame.rename(columns=_unmarked)


def _is_text(kind: Any) -> bool:
    return str(kind) in ("object", "str", "string", "category")


def _marked(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) and not _is_number(value) else value


def _unmarked(value: Any) -> Any:
    return value[1:] if isinstance(value, str) and value.startswith("'") and _FORMULA.match(value) else value


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
