"""The scenario: one TOML file that says what flies, what is sensed, who estimates, what is scored and what is claimed.

`load_scenario` reads it, lays a profile, a variant and single settings over it, and checks it; the result is immutable
plain data. Angles are in degrees here and nowhere else; every key carries its unit.
"""

from testbed.scenario.load import find_scenario, list_scenarios, load_scenario, overlays_of
from testbed.scenario.model import (
    EXTERNAL,
    LONGEST_TIMEOUT_S,
    PRESENTED,
    EstimatorConfig,
    MonteCarloConfig,
    Scenario,
    WindowConfig,
)
from testbed.scenario.settings import check_once, hides, merge, parse_setting, parse_value, position_of, set_key

__all__ = [
    "EXTERNAL",
    "LONGEST_TIMEOUT_S",
    "PRESENTED",
    "EstimatorConfig",
    "MonteCarloConfig",
    "Scenario",
    "WindowConfig",
    "check_once",
    "find_scenario",
    "hides",
    "list_scenarios",
    "load_scenario",
    "merge",
    "overlays_of",
    "parse_setting",
    "parse_value",
    "position_of",
    "set_key",
]
