"""Tables as they stand in files: Parquet, or text of any usual separator, with or without a header, as frames of pandas."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.errors import InputError

if TYPE_CHECKING:
    import pandas as pd


def read_frame(path: Path) -> pd.DataFrame:
    import pyarrow as pa
    import pyarrow.parquet

    try:
        table = pa.parquet.read_table(path) if path.suffix == ".parquet" else _read_text(path)
        names = [name.strip() for name in table.column_names]
        frame = table.rename_columns(names).to_pandas()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable table ({str(error).splitlines()[0]})") from None
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{path}: column '{twice[0]}' is there {names.count(twice[0])} times; keep one")
    if not len(frame):
        raise InputError(f"{path}: has no rows below its header; leave the file out if the sensor recorded nothing")
    return frame


def _read_text(path: Path) -> Any:
    """A CSV file of any usual separator, with or without a header. Raises what pyarrow raises."""
    import io

    import pyarrow.csv as csv

    with path.open("rb") as file:
        head = file.read(65536).decode("utf-8", errors="replace").splitlines()
    if "\0" in "".join(head[:3]):
        raise InputError(f"{path}: not text in UTF-8, but in UTF-16 or binary; save it as CSV in UTF-8")
    rows = [line for line in head[:3] if line.strip()]
    last = rows[-1] if rows else ""
    counts = {mark: min(line.count(mark) for line in rows) if rows else 0 for mark in ";\t|"}
    separator = max(counts, key=lambda mark: counts[mark])
    source: Any = path
    if not counts[separator]:
        blank = "," not in last or (len(last.split()) > 2 and _decimal_commas(last.split()))
        separator = " " if blank and len(last.split()) > 1 else ","
        if blank and separator == " ":  # any number of blanks between two columns
            source = io.BytesIO(
                "\n".join(" ".join(line.split()) for line in path.read_text("utf-8").splitlines()).encode()
            )
    words = last.split(separator)
    comma = separator != "," and _decimal_commas(words)
    headless = bool(rows) and all(
        _is_number(word, comma) for word in rows[0].split(separator if separator != " " else None)
    )
    names = [str(k + 1) for k in range(len(words))] if headless else None
    return csv.read_csv(
        source,
        csv.ReadOptions(column_names=names),
        csv.ParseOptions(delimiter=separator),
        csv.ConvertOptions(decimal_point="," if comma else "."),
    )


def _decimal_commas(words: Sequence[str]) -> bool:
    return any(re.fullmatch(r"\s*[-+]?\d+,\d+(?:[eE][-+]?\d+)?\s*", word) for word in words)


def _is_number(word: str, comma: bool) -> bool:
    try:
        float(word.replace(",", ".") if comma else word)
    except ValueError:
        return False
    return True
