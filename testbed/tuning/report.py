"""The report of a tuning study: ``report.md``, tables as CSV, figures. Reads the folder that `testbed.tuning.tune` wrote.

Objective: sum of the scenario's metrics (m, m/s, degrees). The paper's figures stand in ``[[extra.tune.paper]]``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.csv_text import csv_text, read_csv
from testbed.base.files import as_json, write_atomic
from testbed.base.schema import read_toml
from testbed.montecarlo.folders import Folder
from testbed.tuning import tables
from testbed.tuning.config import DATA_SHEET, INNOVATIONS, tuned_entry
from testbed.tuning.objective import record, scenario_space
from testbed.tuning.speed import TABLE_EVALUATIONS
from testbed.tuning.study import Study
from testbed.tuning.tune import KIND

if TYPE_CHECKING:
    import pandas as pd

SEEDS = 20
PAPER_HOURS = 1140.0


def write_report(folder: str | Path, out: str | Path | None = None, figures: bool = True) -> Path:
    """Write ``report.md``, ``report.html``, tables and figures to ``out`` (default: the study's folder); returns the text's path.

    What `write_speed` and `write_functions` left in ``out`` is shown. Raises InputError when the folder holds no finished study.
    """
    study = Study(Path(folder))
    if out is not None and Path(out).resolve() != study.folder.resolve():
        return _write(study, _Target(Path(out)), figures)
    with Folder.open(study.folder, KIND) as own:
        path = _write(study, _Target(study.folder, own), figures)
        own.save()
    return path


class _Target:
    """Where a report goes: the folder of its study, which lists it, or another one."""

    def __init__(self, path: Path, own: Folder | None = None) -> None:
        self.path, self._own = path, own

    def write(self, name: str, content: bytes) -> None:
        """Write a file."""
        if self._own is not None:
            self._own.write(name, content)
        else:
            write_atomic(self.path / name, content)

    def draw(self, name: str, draw: Callable[[Path], object]) -> None:
        """Have a figure drawn."""
        if self._own is not None:
            self._own.claim([name])
        draw(self.path / name)
        if self._own is not None:
            self._own.finish(name)


def _write(study: Study, to: _Target, figures: bool) -> Path:
    target = to.path
    ranks = tables.rank_sums(study.statistics[_of_paper(study.statistics.columns, study)])
    beside, verdicts = comparison(study), claims(study, ranks)
    written = {"table2.csv": beside, "table4.csv": ranks.reset_index(names="algorithm")}
    if target.resolve() != study.folder.resolve():
        written["heldout.csv"] = study.heldout
    for name, table in written.items():
        to.write(name, csv_text(table, float_format="%.6g").encode())
    parts = [
        f"# {study.manifest['title'] or study.manifest['scenario']}\n",
        _what_was_run(study),
        *_claim_lines(verdicts),
        "## Fitness and time beside the paper's\n",
        markdown(_rows_of(beside, ("fitness", "hours"))),
        "## RMSE of the best candidates on the flight they were tuned on (mean over searches)\n",
        "All statistics are in `table2.csv`; here the means.\n",
        markdown(beside[beside["quantity"].str.contains(":") & (beside["statistic"] == "mean")]),
        *(["## Rank sums (lower is better)\n", markdown(_rank_table(study, ranks))] if len(ranks) else []),
        "## On flights that the search did not see\n",
        "Objective of every result; improvement over the data sheet in %, paired over the unseen runs, 95 % interval.\n",
        markdown(study.heldout.sort_values("train", kind="stable")),
    ]
    if (target / "functions.csv").is_file():
        parts += _functions(target / "functions.csv")
    if (target / "speed.csv").is_file():
        parts += _speed(target / "speed.csv")
    if figures:
        parts += _figures(study, to)
    to.write("report.md", "\n".join(parts).encode())
    _write_page(study, to, verdicts)
    return target / "report.md"


def _write_page(study: Study, to: _Target, verdicts: Sequence[Claim]) -> None:
    """``report.html`` from ``report.md`` and ``findings.md`` beside it, and ``report.json``: what an index shows of the study."""
    from testbed.report import html

    text = to.path / "report.md"
    findings = text.with_name("findings.md")
    source = text.read_text(encoding="utf-8").partition("\n")[2]
    if findings.is_file():
        source = f"## Findings\n\n{findings.read_text(encoding='utf-8')}\n{source}"
    title = str(study.manifest["title"] or study.manifest["scenario"])
    entry = {
        "scenario": study.manifest["scenario"],
        "variant": study.manifest["variant"],
        "title": title + (f", {study.manifest['variant']}" if study.manifest["variant"] else ""),
        "source": study.scenario.scenario.source,
        "sentence": headline(study),
        "runs": len(study.config.test_runs),
        "verdicts": [claim.verdict for claim in verdicts],
    }
    page = html.document(entry["title"], "Navigation testbed, tuning study", entry["sentence"], source, text.parent)
    to.write("report.html", page.encode())
    to.write("report.json", as_json(entry))


def write_functions(folder: str | Path, **settings: Any) -> Path:
    """Measure every algorithm on the benchmark functions (`functions.benchmark_table`) into ``functions.csv``.

    A report that is written to this folder shows it. Twice: with the minimum near the box's centre, and moved by 0.3 half widths.
    """
    import pandas as pd

    from testbed.tuning.functions import benchmark_table

    made = [benchmark_table(**{"seeds": SEEDS, "shift": shift} | settings).assign(shift=shift) for shift in (0.0, 0.3)]
    path = Path(folder) / "functions.csv"
    write_atomic(path, csv_text(pd.concat(made), float_format="%.6g").encode())
    return path


def _functions(path: Path) -> list[str]:

    table = read_csv(path)
    wide = table.pivot(index=["function", "shift"], columns="algorithm", values="median").reset_index()
    order = list(dict.fromkeys(table["algorithm"]))
    return [
        "## Benchmark functions in 18 dimensions\n",
        f"Median of the best value over {SEEDS} seeds, 10,000 evaluations each; the minimum is 0. ``shift`` moves it from the box's centre,"
        " in half widths.\n",
        markdown(wide[["function", "shift", *order]]),
    ]


def _speed(path: Path) -> list[str]:

    return [
        "## What an evaluation costs\n",
        "Both filter runs of it, in s. ``busiest_thread_s`` is processor time: the wall time of a machine with nothing else to do. The last two"
        f" columns come from it; ``table_h`` is the paper's whole table of {TABLE_EVALUATIONS} evaluations, in hours.\n",
        markdown(read_csv(path)),
    ]


def comparison(study: Study) -> pd.DataFrame:
    """Table 2: quantity, statistic, source (ours, paper), one column per algorithm; time in hours."""
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for (quantity, statistic), values in study.statistics.iterrows():
        name, scale = (
            ("hours", 3600.0**-2 if statistic == "variance" else 1 / 3600.0)
            if quantity == "seconds"
            else (quantity, 1.0)
        )
        key = {"quantity": name, "statistic": statistic}
        rows.append(key | {"source": "ours"} | (values * scale).to_dict())
        if printed := study.paper(name, statistic):
            rows.append(key | {"source": "paper"} | printed)
    return pd.DataFrame(rows)


def _what_was_run(study: Study) -> str:
    searches, seconds = study.searches, study.timings
    own = searches[searches["kind"] == "objective"]
    evaluations, total = int(searches["evaluations"].sum()), seconds["seconds"].sum()
    per = total / evaluations
    per_algorithm = own.groupby("algorithm").size().max()
    lines = [
        f"{len(own)} searches ({per_algorithm} of each algorithm; iterations {', '.join(map(str, sorted(set(own['iterations']))))}; "
        f"population {study.config.population}; {len(study.config.cases)} case(s); seen runs {study.config.train_runs}, "
        f"unseen runs {len(study.config.test_runs)}).",
        f"{evaluations} evaluations in {total / 3600:.2f} h, {per:.3f} s each as the machine was loaded; {int(searches['shared'].sum())} of them"
        " are the beginning of a shorter search of the same algorithm and seed (an algorithm without a schedule over its whole length"
        " begins a long search as it does a short one) and were made once.",
    ]
    if study.config.paper:
        lines.append(
            f"The paper's whole table of {TABLE_EVALUATIONS} evaluations would take"
            f" {per * TABLE_EVALUATIONS / 3600:.0f} h at this speed; the paper's took about {PAPER_HOURS:.0f} machine hours."
        )
    if len(own) < 30 and study.config.paper:
        lines.append(
            "This is a reduced set: the paper ran 100 to 500 iterations with a population of 50. Minimum, mean and variance"
            " are over the searches made here, and say correspondingly less."
        )
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Claim:
    """What a paper says, what was found (a verdict of `testbed.scoring.verdicts`, or a longer one that begins like it), and why."""

    text: str
    verdict: str
    why: str


def claims(study: Study, ranks: pd.DataFrame) -> list[Claim]:
    """Verdicts on the paper's three claims, from the tables."""
    found = []
    claimed = study.paper("fitness", "mean")
    favourite = min(claimed, key=lambda a: claimed[a]) if claimed else ""
    own = [a for a in study.algorithms if a in ranks.index]
    if favourite in own:
        fitness = {s: study.statistics.loc[("fitness", s), own].astype(float) for s in ("min", "mean", "variance")}
        best = {s: v.idxmin() for s, v in fitness.items() if v.notna().all()}
        order = list(ranks.sort_values("rank_sum").index)
        paper_ranks = study.paper("rank_sum")
        why = f"Best {', '.join(f'{s}: {a}' for s, a in best.items())}. Order by rank sum: {', '.join(order)}; the paper's:"
        found.append(
            Claim(
                f"{favourite.upper()} has the best fitness of the paper's algorithms",
                "reproduced" if all(a == favourite for a in best.values()) else "not reproduced",
                f"{why} {', '.join(sorted(paper_ranks, key=lambda a: paper_ranks[a]))}.",
            )
        )
    tuned = study.heldout[study.heldout["improvement_pct"].notna() & ~study.heldout["row"].str.startswith(INNOVATIONS)]
    if len(tuned):
        better, worse = int((tuned["ci_low"] > 0.0).sum()), int((tuned["ci_high"] < 0.0).sum())
        train = study.heldout.set_index("row")["train"]
        seen = int((train.loc[tuned["row"]] < train.loc[DATA_SHEET]).sum())
        partly = "in part" if better else "in part: only on the flight that they were tuned on" if seen else ""
        found.append(
            Claim(
                "Tuned settings beat the data sheet",
                "reproduced" if better == len(tuned) else partly or "not reproduced",
                f"On the flight they were tuned on {seen} of {len(tuned)} do; on unseen runs {better} of {len(tuned)} are better and"
                f" {worse} worse with an interval that excludes zero.",
            )
        )
    if claimed:
        per = study.timings["seconds"].sum() / study.searches["evaluations"].sum() / 3600.0
        found.append(
            Claim(
                "Tuning takes 12 to 84 hours per search",
                "not reproduced",
                f"A search of the paper's size (5,000 to 25,000 evaluations) takes {5000 * per:.1f} to {25000 * per:.1f} h here.",
            )
        )
    return found


def headline(study: Study) -> str:
    """The study in one sentence: the best settings on unseen runs against the data sheet."""
    rows = study.heldout[study.heldout["improvement_pct"].notna()].sort_values("test", kind="stable")
    if rows.empty:
        return "Nothing was scored on unseen runs."
    best = rows.iloc[0]
    side = "below" if best["improvement_pct"] > 0 else "above"
    return (
        f"On unseen runs the best search ({best['row']}) stands {abs(best['improvement_pct']):.1f} % {side} the data sheet's"
        f" objective (95 % interval of the improvement {best['ci_low']:.1f} to {best['ci_high']:.1f} %)."
    )


def _claim_lines(verdicts: Sequence[Claim]) -> list[str]:
    lines = [f"{k}. {claim.text}: **{claim.verdict}**. {claim.why}" for k, claim in enumerate(verdicts, 1)]
    return ["## Claims\n", *lines, ""]


def _rank_table(study: Study, ranks: pd.DataFrame) -> pd.DataFrame:
    table = ranks.sort_values("rank_sum").reset_index(names="algorithm")
    if printed := study.paper("rank_sum"):
        table["paper (of 128 rows)"] = [printed.get(a, np.nan) for a in table["algorithm"]]
    return table


def _of_paper(columns: Any, study: Study) -> list[str]:
    """The algorithms that the paper has; all where the scenario quotes no paper."""
    printed = study.paper("fitness", "mean")
    return [a for a in columns if not printed or a in printed]


def _rows_of(table: pd.DataFrame, quantities: tuple[str, ...]) -> pd.DataFrame:
    return table[table["quantity"].isin(quantities)]


def _figures(study: Study, to: _Target) -> list[str]:
    from testbed.tuning import plots

    space = scenario_space(study.scenario, study.config)
    base = float(study.heldout.set_index("row").loc[DATA_SHEET, "train"])
    to.draw("convergence.png", lambda path: plots.convergence(study.history, study.searches, path, base))
    to.draw("variables.png", lambda path: plots.variables(study.searches, space.names, *space.bounds, path))
    own = study.searches[study.searches["kind"] == "objective"]
    best = own.loc[own["best"].idxmin(), "search"]
    entry, listed = tuned_entry(study.scenario, study.config), Folder(study.folder, study.manifest)
    candidates = {DATA_SHEET: dict(entry.params), best: read_toml(listed.check(f"best/{best}.toml"))["params"]}
    texts = [
        "## Figures\n",
        "![convergence](convergence.png)\n",
        "![variables of the best candidates](variables.png)\n",
    ]
    for recording in record(study.scenario, study.config, study.config.train_runs[:1]):
        name = f"best-{recording.case}.png"
        to.draw(name, partial(plots.best_flight, entry.name, candidates, recording))
        texts.append(f"![errors of the best candidate, {recording.case}]({name})\n")
    return texts


def markdown(table: pd.DataFrame) -> str:
    """A table as Markdown; numbers with four figures."""

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return "" if np.isnan(value) else f"{value:.4g}"
        return str(value)

    head = "| " + " | ".join(map(str, table.columns)) + " |"
    rule = "| " + " | ".join("---:" if table[c].dtype.kind in "fi" else "---" for c in table.columns) + " |"
    body = ["| " + " | ".join(cell(v) for v in row) + " |" for row in table.itertuples(index=False)]
    return "\n".join([head, rule, *body]) + "\n"
