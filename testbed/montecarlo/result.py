"""A finished batch of runs, as `testbed.run` returns it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from testbed.data.shown import Shown
from testbed.montecarlo.store import open_result
from testbed.scoring.quantities import MAIN, metric_label, unit

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(repr=False)
class Result(Shown):
    """A finished batch: where it is stored, and its tables."""

    out: Path
    runs: pd.DataFrame
    summary: pd.DataFrame
    claims: pd.DataFrame
    timings: pd.DataFrame
    improvements: pd.DataFrame
    consistency: pd.DataFrame
    notes: tuple[str, ...] = ()
    """What the scenario says without effect, see `testbed.base.notes`."""
    near_pole: bool = False
    """Whether the motion comes where Euler angles say little of the attitude."""

    @property
    def metrics(self) -> pd.DataFrame:
        """The long table of every run, read from the disk: run, estimator, window, metric, value."""
        import pandas as pd

        return pd.read_parquet(open_result(self.out).check("metrics.parquet"))

    def plot(self, kind: str = "errors", *estimators: str, metric: str = "", window: str = "all") -> Figure:
        """A figure (matplotlib) of a kind of ``testbed plot``; raises InputError where there is none, or nothing to draw."""
        from testbed.report import single

        return single.draw(self.out, kind, single.Wanted(estimators, metric, window), "page")

    def _told(self) -> tuple[str, list[tuple[str, str]]]:
        """Number of runs; of each estimator the main error over all time, and runs that it did not finish; verdicts."""
        metric = f"rmse_{MAIN[0]}"
        whole = self.summary[(self.summary["window"] == "all") & (self.summary["metric"] == metric)]
        means = whole.set_index("estimator")["mean"]
        rows = []
        for estimator, status in self.runs.groupby("estimator", sort=False)["status"]:
            text = f"{means[estimator]:.4g} {unit(metric)}" if estimator in means else "not scored"
            missed = int((status != "ok").sum())
            rows.append((str(estimator), f"{text}, {missed} of {len(status)} runs not finished" if missed else text))
        for verdict, count in (self.claims["verdict"].value_counts() if len(self.claims) else {}).items():
            rows.append(("claims", f"{count} {verdict}"))
        return f"Result {self.out}: {self.runs['run'].nunique()} runs, {metric_label(metric)}", rows
