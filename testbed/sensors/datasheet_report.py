"""The report on the catalogue's IMUs: 6 h at rest each, Allan-fitted, beside their data sheets.

Writes ``allan.csv``, ``README.md`` and one plot per unit into a folder; `make reports` runs it. Limits are those that the
models must meet: random walks 3 %, bias instability 15 %, rate random walk 20 %, over the three axes of a unit.
"""

from __future__ import annotations

from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from testbed.sensors import allan, catalog, list_sensors, static_log

if TYPE_CHECKING:
    import pandas as pd

DURATION_S = 6 * 3600.0
FIRST_SEED = 1
"""Of the first unit; each next one has the next, so that no two share their draws."""
LIMITS_PCT = {"ARW": 3.0, "VRW": 3.0, "bias instability": 15.0, "RRW": 20.0}

TEXT = """# IMUs of the catalogue at rest

{hours:g} hours of each unit at rest, level, at the rate of its catalogue entry, with draws of its own (seeds {seed}, {next}, ... in the
order of the table); overlapping Allan deviation (NIST SP 1065, eq. 11); fit of white noise, first-order Gauss-Markov bias and rate random walk to the curve of the three axes together
(the mean of their Allan variances). Regenerate with `make reports`. Per-axis figures: [allan.csv](allan.csv).

{table}

How to read it:

- The bias instability of the data sheet is taken as the top of the Allan deviation of the Gauss-Markov bias, 0.617 of its
  sigma. In the total curve it stands on the white noise that is left at that cluster time, so it is the fit that is
  compared, not the lowest point of the curve. A process that a specification does not have is not fitted; the correlation
  time is fitted, not taken from the catalogue.
- `std` is the sampling error of the fit for a record of this length, with what neighbouring cluster times share. A figure
  that is not told apart from zero is not given.
- The quantisation error of a coarse part (ADIS16405: 3.33 mg/LSB) is within the data sheet's random walk, which is
  measured at the output: the generator draws only what quantisation does not add.
- The correlation time of the bias has no limit: the "data sheet" column has the catalogue's, an assumption.
- A first-order Gauss-Markov process has a hump, not a long flat. Where a part's white noise is low (accelerometers of the
  ADIS16488) its curve dips below the bias instability before the hump, and behind it falls again; a real part's flicker
  noise would do neither. Data sheets give no correlation time; see the note at the head of the catalogue.
- A difference within the limit says that the generator agrees with the catalogue, not that the catalogue agrees with a part.

{plots}
"""


def write_report(folder: Path, duration_s: float = DURATION_S, first_seed: int = FIRST_SEED) -> pd.DataFrame:
    """Write the report; returns the table of all units (columns of `allan.analyse`, with ``imu`` before them)."""
    import pandas as pd

    folder.mkdir(parents=True, exist_ok=True)
    tables: list[pd.DataFrame] = []
    plots: list[str] = []
    for model in list_sensors()["imu"]:
        rate = catalog.entry("imu", model).get("rate_hz")
        if rate is None:  # ideal: nothing to fit
            continue
        log = static_log(model, rate, duration_s, first_seed + len(tables))
        table = allan.analyse(log)
        table.insert(0, "imu", model)
        tables.append(table)
        allan.plot(log, folder / f"{model}.png")
        plots.append(f"![Allan deviation of {model}]({model}.png)")
    whole = pd.concat(tables, ignore_index=True)
    whole.to_csv(folder / "allan.csv", index=False, float_format="%.6g")
    told = {"hours": duration_s / 3600.0, "seed": first_seed, "next": first_seed + 1}
    text = TEXT.format(**told, table=_markdown(whole), plots="\n\n".join(plots))
    (folder / "README.md").write_text(text, encoding="utf-8")
    return whole


def _markdown(table: pd.DataFrame) -> str:
    """The rows of all axes together, with the limit and whether it is met."""
    lines = [
        "| IMU | figure | unit | data sheet | fitted | std | difference | limit | |",
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for row in table[table["axis"] == "all"].to_dict("records"):
        limit = LIMITS_PCT.get(row["figure"])
        met = limit is not None and abs(row["difference_pct"]) <= limit
        verdict = "met" if met else row["note"] or ("" if limit is None else "MISSED")
        cells = [
            *(row["imu"], f"{row['triad']} {row['figure']}", row["unit"], f"{row['data_sheet']:.4g}"),
            *(
                f"{row['fitted']:.4g}",
                "" if isnan(row["std"]) else f"{row['std']:.2g}",
                f"{row['difference_pct']:+.2f} %",
            ),
            *("" if limit is None else f"{limit:g} %", verdict),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    write_report(Path("reports/sensors"))
