"""``[extra.tune]`` of a scenario: what is tuned, over which box, for which objective, by which searches.

Checked by pydantic; dotted keys in ``set`` are those of the scenario. Angles in degrees, metres, m/s, as metric names say.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from testbed.base.errors import InputError, nearest
from testbed.base.schema import Table, validate
from testbed.scenario import EstimatorConfig, Scenario, set_key
from testbed.scoring.quantities import AXES, metric_names
from testbed.tuning.search import PAPER, algorithm, least_population
from testbed.tuning.space import AxisConfig

RMSE_METRICS = [f"rmse_{axis}" for axis in AXES]
Count = Annotated[int, Field(ge=1)]
Run = Annotated[int, Field(ge=0)]
DATA_SHEET = "data-sheet"
"""Row of the parameters that the scenario gives, in the tables of a study."""
FRESH_RUNS = 1_000_000
"""First run of ``noise = "fresh"``; each search has as many of its own, so that none is met twice."""
INNOVATIONS = "innovations"
"""Prefix of the row of the search for the likeliest innovations."""


class CaseConfig(Table):
    """``[[extra.tune.cases]]``: the scenario with some settings changed; the objective is the sum over the cases."""

    name: str
    """As the tables call it."""
    set: dict[str, Any] = {}
    """Settings by their dotted keys, as ``--set`` takes them."""


class PaperRow(Table):
    """``[[extra.tune.paper]]``: a printed figure per algorithm, to stand beside ours."""

    quantity: str
    """``fitness``, ``hours``, ``rank_sum``, or CASE:METRIC, for example ``ADIS16405:rmse_yaw_deg``."""
    statistic: str = ""
    """``min``, ``max``, ``mean``, ``variance``"""
    values: dict[str, float]
    """The figure of each algorithm by its name."""


class TuneConfig(Table):
    """``[extra.tune]``"""

    estimator: str = ""
    """Label of the row of ``[[estimators]]`` to be tuned; default: the first. Its own params stay where none is searched."""
    algorithms: list[str] = list(PAPER)
    """What searches: ga, pso, ipo, mipo, sipo, iipo, cma-es, de."""
    iterations: list[Count] = [100]
    """A search for each number of iterations."""
    population: Annotated[int, Field(ge=2)] = 50
    """Candidates per iteration."""
    seeds: list[Run] = [1]
    """One search per algorithm, number of iterations and seed."""
    metrics: list[str] = RMSE_METRICS
    """The objective is their sum, over the cases, averaged over the runs."""
    window: str = "all"
    """Over which the metrics are taken."""
    train_runs: Annotated[list[Run], Field(min_length=1)] = [0]
    """Monte Carlo runs that the search sees."""
    test_runs: list[Run] = []
    """Monte Carlo runs that it does not see, on which every result is scored."""
    cases: list[CaseConfig] = [CaseConfig(name="all")]
    space: list[AxisConfig] = []
    """Default: all that the estimator declares."""
    settings: dict[str, dict[str, Any]] = {}
    """Settings of an algorithm: keywords of its function."""
    noise: Literal["frozen", "fresh"] = "frozen"
    """Whether every candidate meets the noise of ``train_runs``, or each one noise that no other has met (turn-on errors too)."""
    stride: Count = 10
    """Every so many samples count during the search, where the estimator offers a fast path."""
    penalty: Annotated[float, Field(gt=0)] = 1e6
    """Objective of a candidate that diverges."""
    target: float | None = None
    """A search stops once it is as good as this."""
    stall: Count | None = None
    """A search stops after so many iterations without any improvement."""
    innovation_search: Literal["cma-es", "de", "pso", "ga", "none"] = "cma-es"
    """Algorithm of the row that maximises the likelihood of the innovations, which needs no truth."""
    paper: list[PaperRow] = []

    @model_validator(mode="after")
    def _known(self) -> TuneConfig:
        try:
            for name in [*self.algorithms, *self.settings]:
                algorithm(name)
        except InputError as error:
            raise ValueError(str(error)) from None
        for name in [*self.algorithms, *({self.innovation_search} - {"none"})]:
            if self.population < (least := least_population(name)):
                raise ValueError(f"population is {self.population}, but algorithm '{name}' needs at least {least}")
        for metric in self.metrics:
            if metric not in metric_names():
                raise ValueError(f"unknown metric '{metric}'; {nearest(metric, metric_names())}")
        if len({axis.name for axis in self.space}) < len(self.space):
            raise ValueError("space names a parameter twice")
        if len({case.name for case in self.cases}) < len(self.cases) or not self.cases:
            raise ValueError("cases need names that differ")
        if shared := set(self.train_runs) & set(self.test_runs):
            raise ValueError(f"runs {sorted(shared)} are both train_runs and test_runs")
        if self.noise == "fresh" and max(self.train_runs + self.test_runs) >= FRESH_RUNS:
            raise ValueError(f"runs from {FRESH_RUNS} on are those of noise = 'fresh'")
        return self


def tune_config(scenario: Scenario, **changes: Any) -> TuneConfig:
    """The scenario's ``[extra.tune]``, with ``changes`` that are not None. Raises InputError for a wrong key."""
    data = dict(scenario.extra.get("tune", {})) | {k: v for k, v in changes.items() if v is not None}
    config = validate(TuneConfig, data, f"{scenario.source_path or scenario.name}: [extra.tune]")
    tuned_entry(scenario, config)
    return config


def tuned_entry(scenario: Scenario, config: TuneConfig) -> EstimatorConfig:
    """The row of ``[[estimators]]`` that is tuned."""
    rows = {entry.row: entry for entry in scenario.estimators}
    if not config.estimator:
        return scenario.estimators[0]
    if config.estimator not in rows:
        raise InputError(
            f"{scenario.source_path}: [extra.tune] estimator: no row '{config.estimator}'; {nearest(config.estimator, rows)}"
        )
    return rows[config.estimator]


def case_scenario(scenario: Scenario, case: CaseConfig) -> Scenario:
    """The scenario of a case."""
    if not case.set:
        return scenario
    data = scenario.to_data()
    source = f"{scenario.source_path}: [extra.tune] case '{case.name}'"
    for key, value in case.set.items():
        set_key(data, key, value, source)
    made = validate(Scenario, data, source, scenario.folder)
    made._source = scenario.source_path
    return made


@dataclass(frozen=True)
class Task:
    """One search: what a row of the tables stands for."""

    algorithm: str
    iterations: int
    seed: int
    likelihood: bool = False

    @property
    def name(self) -> str:
        """Its file name."""
        return f"{INNOVATIONS + '-' if self.likelihood else ''}{self.algorithm}-{self.iterations:04d}-seed{self.seed}"

    def fresh_runs(self, first: int, count: int) -> range:
        """The Monte Carlo runs whose noise its evaluations from ``first`` on meet under ``noise = "fresh"``."""
        start = FRESH_RUNS * (1 + self.seed) + first
        return range(start, start + count)


def tasks_of(config: TuneConfig) -> list[Task]:
    """The searches of a study, short ones first; then the likelihood search, as long as the first of them."""
    out = [Task(a, n, seed) for n in sorted(config.iterations) for seed in config.seeds for a in config.algorithms]
    if config.innovation_search != "none":
        out.append(Task(config.innovation_search, min(config.iterations), config.seeds[0], True))
    return out
