"""Writes what the estimators answer on the recordings of `parity_logs`: ``python tests/parity/record.py [RECORDING...]``.

One file per recording in ``recorded/``, a column per line; a column of equal numbers is written as one number. Latitude and
longitude have 17 digits, all else 12 and sigmas 11: hundredths of what the comparison allows.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from parity_cases import PLANS, SEARCHED, answer, cases, figures, reference, scores, sensor_log
from parity_logs import Array, digest, recording, truth

FOLDER = Path(__file__).parent / "recorded"


def dump(data: dict[str, Any]) -> str:
    """JSON with a line per column."""
    lines = ["{", f' "hash": "{data["hash"]}"']
    for case, tables in data.items():
        if case == "hash":
            continue
        lines[-1] += ","
        lines.append(f" {json.dumps(case)}: {{")
        for table, columns in tables.items():
            lines.append(f"  {json.dumps(table)}: {{")
            lines += [
                f"   {json.dumps(key)}: {numbers(column, digits(table, key))}," for key, column in columns.items()
            ]
            lines[-1] = lines[-1][:-1]
            lines.append("  },")
        lines[-1] = "  }"
        lines.append(" }")
    return "\n".join([*lines, "}"]) + "\n"


def digits(table: str, column: str) -> int:
    """Significant digits of a column."""
    return 17 if column in ("lat", "lon") else 11 if table == "sigma" else 12


def numbers(column: Array, digits: int) -> str:
    """A column as JSON."""
    if len(column) and (column == column[0]).all():
        return f"{column[0]:.{digits}g}"
    return "[" + ",".join("NaN" if np.isnan(x) else f"{x:.{digits}g}" for x in column) + "]"


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for plan in PLANS:
        if sys.argv[1:] and plan.name not in sys.argv[1:]:
            continue
        tables = recording(plan)
        log = sensor_log(plan, tables)
        data: dict[str, Any] = {"hash": digest(tables)}
        for case in cases(plan):
            data[case.label] = figures(case, answer(case, log))
        if plan.name in SEARCHED:
            data["searcher"] = scores(log, reference(truth(plan)))
        path = FOLDER / f"{plan.name}.json"
        path.write_text(dump(data))
        print(f"{path.name}: {len(data) - 1} cases, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
