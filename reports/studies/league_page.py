"""The league's table as git keeps it: ``testbed league --data DRIVE``, then ``python reports/studies/league_page.py results/league``.

``reports/league/report.md`` is what ``findings.md`` says and the tables of that run; beside it its figure and ``league.json``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from pictures import shrink

PLACE = Path(__file__).resolve().parents[1] / "league"


def keep(result: Path) -> Path:
    """Make the page of a finished league; its path."""
    for name in ("league.json", "league.png"):
        shutil.copyfile(result / name, PLACE / name)
    shrink(PLACE)
    head, _, tables = (result / "league.md").read_text(encoding="utf-8").partition("\n\n")
    findings = (PLACE / "findings.md").read_text(encoding="utf-8").strip()
    page = PLACE / "report.md"
    page.write_text(f"{head}\n\n{findings}\n\n{tables}", encoding="utf-8")
    return page


if __name__ == "__main__":
    print(keep(Path(sys.argv[1])))
