"""JSBSim behind four calls: start, control, run, read. Everything that is peculiar to JSBSim's interface stays here.

JSBSim (Berndt, AIAA 2004-4923) works in feet, slugs and degrees Rankine; what leaves this module is SI and radians.
Turbulence is JSBSim's Dryden model after MIL-F-8785C.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from testbed.base.errors import InputError
from testbed.flight.aircraft import AnyAircraft, Multirotor
from testbed.flight.config import FlightConfig
from testbed.flight.models import ModelPaths, clean_copy
from testbed.flight.undercarriage import Undercarriage

FOOT = 0.3048
KILOGRAM_PER_POUND = 0.45359237
KELVIN_PER_RANKINE = 5.0 / 9.0
TURBULENCE_MILSPEC = 4
"""JSBSim's Dryden model with its filters in Tustin's form, whose gusts are smoother than those in Euler's (type 3)."""
TURBULENCE_SLOW = 3
"""The same in Euler's form, of first order across: at the airspeed of a hover, which changes by as much as the gusts do, the
second-order filters of Tustin's form swell (across 4.7 m/s rms where MIL-F-8785C wants 1.4, in a flight of ten minutes)."""
TURBULENCE = {"none": (0.0, 0), "light": (25.0, 3), "moderate": (50.0, 4), "severe": (75.0, 6)}
"""Wind at 20 ft (ft/s) and severity index of the probability of exceedance, MIL-F-8785C."""

INTEGRATORS = (
    "simulation/integrator/rate/rotational",
    "simulation/integrator/rate/translational",
    "simulation/integrator/position/rotational",
    "simulation/integrator/position/translational",
)
IN_THE_AIR = (4, 4, 4, 4)
"""Adams-Bashforth of third order for all: it holds the check cases (`tests/flight/test_nesc.py`), where JSBSim's own
choice, Euler for the rates, turns a tumbling brick 2.6 degrees wrong in 30 s; fourth order is no better and less stable."""
ON_WHEELS = (1, 3, 1, 4)
"""JSBSim's own: the friction of a wheel that stands is solved for a rate of one step."""

STATE = (
    ("velocities/v-north-fps", FOOT),
    ("velocities/v-east-fps", FOOT),
    ("velocities/v-down-fps", FOOT),
    ("attitude/phi-rad", 1.0),
    ("attitude/theta-rad", 1.0),
    ("attitude/psi-rad", 1.0),
)
"""What is sampled for the truth: velocity in n and Euler angles, with the factor to SI."""


class Simulator:
    """One JSBSim executive, loaded with an aircraft and placed at the flight's initial state."""

    def __init__(self, config: FlightConfig, aircraft: AnyAircraft, folder: Path, dt: float, seed: int) -> None:
        self._file = folder / "aircraft.toml"
        self._check_properties(aircraft)
        self.fdm = _load(aircraft, folder, dt)
        self.run: Callable[[], bool] = self.fdm.run
        self.dt = dt
        self._nodes = self.fdm.get_property_manager().get_node
        self._wind = config.wind
        self._turbulence = TURBULENCE_SLOW if isinstance(aircraft, Multirotor) else TURBULENCE_MILSPEC
        self.undercarriage = Undercarriage(self.fdm)
        self.integrate(ON_WHEELS if config.initial.parked else IN_THE_AIR)
        self._start(config, aircraft, seed)
        engine = aircraft.model.engine_property
        self._node(engine, "'model.engine_property'")
        self.state = self._readers([name for name, _ in STATE])
        self.air = self._readers(
            ["fcs/left-aileron-pos-norm", "fcs/elevator-pos-norm", "fcs/rudder-pos-norm", engine]
            + [f"atmosphere/total-wind-{axis}-fps" for axis in ("north", "east", "down")]
            + ["atmosphere/T-R"]
        )
        self.motion = self._readers(
            [
                "velocities/p-rad_sec",
                "velocities/q-rad_sec",
                "velocities/r-rad_sec",
                "velocities/vt-fps",
                "aero/alpha-rad",
                "aero/beta-rad",
                "position/geod-alt-ft",
                "velocities/h-dot-fps",
            ]
        )
        self.place = self._readers(["position/lat-geod-rad", "position/long-gc-rad", "position/h-agl-ft"])
        throttles = ["fcs/throttle-cmd-norm"] + [
            f"fcs/throttle-cmd-norm[{i}]" for i in range(1, aircraft.model.engines)
        ]
        surfaces = ["fcs/aileron-cmd-norm", "fcs/elevator-cmd-norm", "fcs/rudder-cmd-norm", "fcs/steer-cmd-norm"]
        self.surfaces = [self._node(name).set_double_value for name in surfaces]
        self.throttles = [
            self._node(name, f"'model.engines' = {aircraft.model.engines}").set_double_value for name in throttles
        ]
        motors = aircraft.model.motors if isinstance(aircraft, Multirotor) else []
        self.motors = [self._node(motor.property, "'model.motors'").set_double_value for motor in motors]

    def integrate(self, rules: tuple[int, int, int, int]) -> None:
        """Integrate by `IN_THE_AIR` or `ON_WHEELS` from here on; past derivatives are kept, so there is no start-up."""
        for name, rule in zip(INTEGRATORS, rules, strict=True):
            self.fdm[name] = rule

    def air_density(self) -> float:
        """Density of the air around it, over that at sea level."""
        return float(self.fdm["atmosphere/sigma"])

    def set_wind(self, share: float) -> None:
        """Let a share (0 to 1) of the steady wind blow."""
        for axis in ("north", "east", "down"):
            self.fdm[f"atmosphere/wind-{axis}-fps"] = share * getattr(self._wind, f"{axis}_mps") / FOOT

    def turbulence_on(self) -> None:
        """Start the turbulence that the flight asks for."""
        wind, severity = TURBULENCE[self._wind.turbulence]
        if severity:
            self.fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = wind
            self.fdm["atmosphere/turbulence/milspec/severity"] = severity
            self.fdm["atmosphere/turb-type"] = self._turbulence

    def _readers(self, names: list[str]) -> list[Callable[[], float]]:
        return [self._node(name).get_double_value for name in names]

    def _node(self, name: str, key: str = "") -> Any:
        """A node of JSBSim's property tree. Raises InputError, with the ``key`` that asks for it, where there is none."""
        if (node := self._nodes(name)) is None:
            place = f"{self._file}: {key}" if key else f"{self._file}"
            raise InputError(f"{place}: the model has no property '{name}'")
        return node

    def _check_properties(self, aircraft: AnyAircraft) -> None:
        for key in ("setup", "stand_in"):
            for name in getattr(aircraft.model, key):
                if name.startswith("simulation/"):
                    raise InputError(f"{self._file}: 'model.{key}': '{name}' steers JSBSim itself; remove it")

    def _start(self, config: FlightConfig, aircraft: AnyAircraft, seed: int) -> None:
        fdm, initial = self.fdm, config.initial
        fdm["simulation/randomseed"] = 1 + seed % (2**31 - 1)
        fdm["ic/lat-geod-deg"] = initial.lat_deg
        fdm["ic/long-gc-deg"] = initial.lon_deg
        fdm["ic/h-sl-ft"] = initial.alt_m / FOOT
        if initial.parked:
            fdm["ic/terrain-elevation-ft"] = initial.alt_m / FOOT
        fdm["ic/psi-true-deg"] = initial.heading_deg % 360.0
        fdm["ic/vt-fps"] = initial.speed_mps / FOOT
        fdm["ic/alpha-deg"] = 0.0 if initial.parked else aircraft.model.alpha_deg
        fdm["ic/theta-deg"] = 0.0 if initial.parked else aircraft.model.alpha_deg
        fdm.run_ic()
        if initial.parked:
            self.undercarriage.put_down()
        if config.payload_kg:
            if not aircraft.model.payload_property:
                raise InputError(f"aircraft '{config.aircraft}' takes no payload; remove payload_kg")
            self._node(aircraft.model.payload_property, "'model.payload_property'")
            fdm[aircraft.model.payload_property] += config.payload_kg / KILOGRAM_PER_POUND
        if not aircraft.model.external_thrust:
            fdm["propulsion/set-running"] = -1
            fdm["propulsion/fuel_freeze"] = 1
        for name, value in aircraft.model.setup.items():
            self._node(name, "'model.setup'")
            fdm[name] = value


def _load(aircraft: AnyAircraft, folder: Path, dt: float) -> Any:
    # JSBSim reads the variable when an executive is made, and prints a banner otherwise
    before = os.environ.get("JSBSIM_DEBUG")
    os.environ["JSBSIM_DEBUG"] = "0"
    try:
        import jsbsim

        fdm = jsbsim.FGFDMExec(None)
    finally:
        if before is None:
            del os.environ["JSBSIM_DEBUG"]
        else:
            os.environ["JSBSIM_DEBUG"] = before
    fdm.set_debug_level(0)
    fdm.set_dt(dt)  # before the model: its lags, rate limits and filters take the step when they are loaded
    model = aircraft.model
    for name, value in model.stand_in.items():
        fdm[name] = value
    with (
        clean_copy(model.jsbsim, model.corrections, model.leave_out)
        if model.shipped
        else nullcontext(ModelPaths(folder, folder, folder)) as paths
    ):
        model_path, engines, systems = (str(path) for path in paths)
        loaded = fdm.load_model_with_paths(model.jsbsim, model_path, engines, systems, False)
    if not loaded:
        raise InputError(f"{folder / 'aircraft.toml'}: JSBSim cannot load the model '{model.jsbsim}'")
    fdm.disable_output()
    return fdm
