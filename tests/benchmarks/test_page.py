"""The page of the measurements says what the files say: slopes, goals met and missed, ratios, and what is missing."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "reports" / "studies"))

import benchmark_page as page
import benchmark_rows as rows

PLACE = {
    "date": "2000-01-01",
    "git": "abc",
    "python": "3",
    "processor": "P",
    "cores": 2,
    "platform": "L",
    "packages": {"numpy": "2"},
}


def path(least: float, samples: int | None = None) -> dict:
    extra = {} if samples is None else {"samples": samples}
    return {"group": "g", "min_s": least, "median_s": 1.5 * least, "rounds": 3, "extra": extra}


def keep(folder: Path, section: str, measured: dict) -> None:
    (folder / f"{section}.json").write_text(json.dumps({"provenance": PLACE, "measured": measured}))


@pytest.mark.parametrize("power", [0.0, 1.0, 2.5])
def test_slope_of_a_power_law_is_its_exponent(power):
    assert page.slope([(n, 3.0 * n**power) for n in (1.0, 4.0, 10.0, 100.0, 700.0)]) == pytest.approx(power, abs=1e-9)


def test_slope_looks_at_large_n():
    """A constant start-up cost of 100 hides behind 1e6 units of work, not behind one."""
    assert page.slope([(10.0**k, 100.0 + 10.0**k) for k in range(7)]) > 0.95


def test_goals_ratios_and_gaps(tmp_path):
    """3 µs: met at 1.5 x 1 µs, missed at 1.5 x 4 µs. The peer's ratio compares times per sample, not of the whole."""
    measured = {
        "test_bench_indirect_kf": path(1e-6 * 1000, 1000),
        "test_bench_python_ins": path(500e-6 * 10, 10),
        "test_bench_triple_product": path(0.5e-6 * 1000, 1000),
        "test_bench_direct_filter[imm-rstekf]": path(20e-6 * 100, 100),
        "test_bench_direct_triple_product": path(1e-6 * 100, 100),
    }
    keep(tmp_path, "paths", measured)
    text = page.render(tmp_path, tmp_path / "page.md").read_text()
    lines = {line.split("|")[1].strip(): line for line in text.splitlines() if line.startswith("| ")}
    assert "| 1.50 µs | yes |" in lines["`indirect-kf`, all in, per sample"]
    assert "| 500 x | yes |" in lines["`indirect-kf` against python-ins, same process"]
    assert "| 30.0 µs | **no** |" in lines["`imm-rstekf` per sample"]
    assert "not measured" in lines["`testbed --help`"] and lines["`testbed --help`"].endswith("| - |")
    assert "| 2.00 | python-ins, covariance at 10 Hz 500 |" in lines["`indirect-kf`"]
    assert "| 6.67 |" in lines["`imm-rstekf`"], "three triple products stand below three branches"
    assert "2000-01-01" in text and "numpy 2" in text


def test_scale_and_memory(tmp_path):
    stages = {"fly": 1.0, "sense": 0.1, "estimate": 0.2, "score": 0.1}

    def job(n: int) -> dict:
        seconds = {name: n * s for name, s in stages.items()}
        return {"seconds": seconds, "peak_mib": dict.fromkeys(stages, 300.0 + n), "samples": n, "start_mib": 250.0}

    runs = {str(n): {"seconds": 0.1 * n, "peak_mib": 300.0} for n in (1, 10, 100)}
    states = {name: {str(n): float(n**2) for n in (3, 6, 12)} for name in ("propagate", "sigma_points")}
    scale = {"length": {str(n): job(n) for n in (60, 600, 6000)}, "runs": runs, "estimators": runs, "states": states}
    keep(tmp_path, "scale", scale)
    keep(tmp_path, "many-runs", {"1000": {"seconds": 100.0, "peak_mib": 301.0}})
    keep(tmp_path, "memory", {"9 h at 50 Hz": job(1000)})
    text = page.render(tmp_path, tmp_path / "page.md").read_text()
    assert "| length | fly | 60 to 6,000 | 60.0 to 6,000 seconds | 1.00 |" in text
    assert "| states | sigma points | 3 to 12 | 9.00 to 144 microseconds | 2.00 |" in text
    assert "| runs | whole job | 1 to 1,000 |" in text and "| 1,000 | 301 |" in text
    assert (tmp_path / "scale-length.png").stat().st_size > 1000


def test_every_row_names_a_benchmark_that_exists():
    """A renamed benchmark must not vanish from the page in silence."""
    source = "".join(file.read_text() for file in Path(__file__).parent.glob("test_bench_*.py"))
    for row in rows.ROWS:
        for name in filter(None, (row.name, row.floor, *row.peers.values())):
            assert f"def {name.split('[')[0]}(" in source, name
