"""Wheels, brakes, flaps and the ground under them: what the manoeuvres on a runway use of JSBSim. SI units and radians.

A parked aircraft is held by ``forces/hold-down``: a body fixed to the Earth to 1e-11 m/s, the truth of an alignment at rest.
JSBSim's wheels stand as well, once its friction has taken hold, but not before some ten seconds.
"""

from __future__ import annotations

import math
from typing import Any

from testbed.base.errors import FlightError

FOOT = 0.3048
INCHES_PER_FOOT = 12.0
STANDING = 1e-6
"""Speed (m/s) and rates (rad/s): what is slower stands, without a step of velocity when it is held."""
SETTLE_S = 90.0
"""The gear of the shipped models has settled after 20 s."""
MOST_UNITS = 64


class Undercarriage:
    """The wheels of a loaded model, and what is moved by hand on the ground."""

    def __init__(self, fdm: Any) -> None:
        self._fdm = fdm
        node = fdm.get_property_manager().get_node
        kinds = [f"{kind}/unit[{k}]" for k in range(MOST_UNITS) for kind in ("gear", "contact")]
        self._units = [unit for unit in kinds if node(f"{unit}/WOW") is not None]
        """JSBSim numbers wheels and other points that may touch the ground in one row; of some models all are gear."""
        self._contacts = [node(f"{unit}/WOW").get_double_value for unit in self._units]
        self._height = node("position/h-agl-ft").get_double_value
        self._velocity = [node(f"velocities/v-{axis}-fps").get_double_value for axis in ("north", "east", "down")]
        self._rates = [node(f"velocities/{axis}-rad_sec").get_double_value for axis in ("p", "q", "r")]
        self._wheels: list[int] = []
        self.parked_height, self.parked_pitch = 0.0, 0.0

    def put_down(self) -> None:
        """Place the aircraft, at rest and level, where its lowest wheel touches the ground; before anything else is set.

        From there it settles by itself: a trim on the ground leaves a creep of 0.3 mm/s. Raises FlightError without wheels.
        """
        fdm = self._fdm
        wheels = [unit for unit in self._units if unit.startswith("gear")]
        if not wheels:
            raise FlightError("the model has no wheels to stand on")
        lowest = min(fdm[f"{unit}/z-position"] for unit in wheels)
        fdm["ic/h-agl-ft"] = (fdm["inertia/cg-z-in"] - lowest) / INCHES_PER_FOOT
        fdm.run_ic()

    def settle(self, steps_per_second: float) -> int:
        """Wait until the aircraft stands on its wheels, with brakes set and engines idling; the steps that it took.

        Raises FlightError when it never does.
        """
        fdm = self._fdm
        self.gear(True)
        self.brake(1.0)
        quiet, steps, each = 0, 0, round(steps_per_second)
        for _ in range(round(SETTLE_S)):
            for _ in range(each):
                fdm.run()
            steps += each
            quiet = quiet + 1 if self.stands() else 0
            if quiet > 1:
                break
        else:
            raise FlightError(f"it does not come to rest on its wheels within {SETTLE_S:g} s")
        self._wheels = [k for k, touches in enumerate(self._contacts) if touches()]
        self.parked_height, self.parked_pitch = self._height() * FOOT, fdm["attitude/theta-rad"]
        return steps

    def stands(self, limit: float = STANDING) -> bool:
        """Whether nothing moves any more: speed (m/s) and rates (rad/s) are below ``limit``."""
        speed = FOOT * math.hypot(*(read() for read in self._velocity))
        return speed < limit and max(abs(read()) for read in self._rates) < limit

    def hold(self, fast: bool) -> None:
        """Fix the aircraft to the ground, or let it go."""
        self._fdm["forces/hold-down"] = 1.0 if fast else 0.0

    def brake(self, share: float) -> None:
        """All wheel brakes, 0 to 1."""
        for side in ("left", "right", "center"):
            self._fdm[f"fcs/{side}-brake-cmd-norm"] = share

    def flaps(self, share: float) -> None:
        """Flaps, 0 to 1 of their range; they take their time."""
        self._fdm["fcs/flap-cmd-norm"] = share

    def gear(self, down: bool) -> None:
        """Lower or raise the gear; it takes its time."""
        self._fdm["gear/gear-cmd-norm"] = 1.0 if down else 0.0

    def height(self) -> float:
        """Of the wheels over the ground, m: 0 as the aircraft stands parked."""
        return float(self._height()) * FOOT - self.parked_height

    def wheels_down(self) -> int:
        """How many wheels touch the ground."""
        return sum(1 for k in self._wheels if self._contacts[k]())

    def strikes(self) -> bool:
        """Whether anything but a wheel touches the ground."""
        return any(touches() for k, touches in enumerate(self._contacts) if k not in self._wheels)
