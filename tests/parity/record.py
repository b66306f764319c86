"""Writes what the estimators answer on the recordings of `parity_logs`: ``python tests/parity/record.py [ESTIMATOR...]``.

With names of estimators only theirs is written anew, as after a fault of theirs was mended; all else stays as it was.

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
from parity_logs import digest, recording, truth

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


def numbers(column: Any, digits: int) -> str:
    """A column as JSON."""
    column = np.atleast_1d(column)
    if len(column) and (column == column[0]).all():
        return f"{column[0]:.{digits}g}"
    return "[" + ",".join("NaN" if np.isnan(x) else f"{x:.{digits}g}" for x in column) + "]"


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    wanted = sys.argv[1:]
    for plan in PLANS:
        path, tables = FOLDER / f"{plan.name}.json", recording(plan)
        log, old = sensor_log(plan, tables), json.loads(path.read_text()) if wanted else {}
        data: dict[str, Any] = {"hash": digest(tables)}
        for case in cases(plan):
            new = not wanted or case.estimator in wanted
            data[case.label] = figures(case, answer(case, log)) if new else old[case.label]
        if plan.name in SEARCHED:
            data["searcher"] = old["searcher"] if wanted else scores(log, reference(truth(plan)))
        path.write_text(dump(data))
        print(f"{path.name}: {len(data) - 1} cases, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
