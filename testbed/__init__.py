"""Navigation testbed: JSBSim flies, sensor models record, estimators estimate, the bench compares.

The picture, one public function per arrow and one class per noun::

    scenario ── fly ──> Trajectory ── sense(seed) ──> SensorLog ── estimator.run ──> NavSolution ── score ──> table
                (truth)               (per run)

>>> scenario = load_scenario("quickstart")
>>> trajectory = fly(scenario)  # or fly("quickstart")
>>> log, errors = sense(scenario, trajectory, seed=0)
>>> solution = make_estimator("indirect-kf").run(log)
>>> table = score(scenario, trajectory, solution)

`run(scenario, out)` does all of it over many seeds and returns a `Result`; ``testbed report OUT`` makes its page.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from testbed import kernel_cache
from testbed.base import linear_algebra, old_names

if TYPE_CHECKING:
    from testbed.base.errors import FlightError, InputError, TestbedError
    from testbed.data.records import InitialState, NavSolution, SensorErrors, SensorLog, Trajectory
    from testbed.data.registry import list_estimators, load_plugin, make_estimator
    from testbed.montecarlo.result import Result
    from testbed.montecarlo.runner import run
    from testbed.pipeline import fly, score, sense
    from testbed.report.one_run import plot_errors, solution_errors
    from testbed.scenario import Scenario, list_scenarios, load_scenario

__version__ = "0.1.0"

_HOME = {
    "testbed.base.errors": ("FlightError", "InputError", "TestbedError"),
    "testbed.pipeline": ("fly", "score", "sense"),
    "testbed.data.records": ("InitialState", "NavSolution", "SensorErrors", "SensorLog", "Trajectory"),
    "testbed.data.registry": ("list_estimators", "load_plugin", "make_estimator"),
    "testbed.montecarlo.result": ("Result",),
    "testbed.montecarlo.runner": ("run",),
    "testbed.report.one_run": ("plot_errors", "solution_errors"),
    "testbed.scenario": ("Scenario", "list_scenarios", "load_scenario"),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}
__all__ = [
    "FlightError",
    "InitialState",
    "InputError",
    "NavSolution",
    "Result",
    "Scenario",
    "SensorErrors",
    "SensorLog",
    "TestbedError",
    "Trajectory",
    "fly",
    "list_estimators",
    "list_scenarios",
    "load_plugin",
    "load_scenario",
    "make_estimator",
    "plot_errors",
    "run",
    "score",
    "sense",
    "solution_errors",
]


linear_algebra.choose_kernels()
kernel_cache.use_folder()
old_names.keep()


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import testbed`` stays light."""
    if name in _MODULE:
        return getattr(import_module(_MODULE[name]), name)
    raise AttributeError(f"module 'testbed' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULE])
