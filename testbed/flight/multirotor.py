"""Flying a multirotor: the cascade ticks at the aircraft's rate around one simulator, guidance at 10 Hz.

A flight begins in the air, hovering, or parked on level ground at the height that the scenario says. SI units and radians.
"""

from __future__ import annotations

import math
import struct
from array import array
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import FlightError
from testbed.flight import manoeuvre_config as cfg
from testbed.flight import multirotor_kernels as mk
from testbed.flight.aircraft import Multirotor
from testbed.flight.autopilot_kernels import desk_views
from testbed.flight.config import FlightConfig
from testbed.flight.driver import GUST_S, SETTLE_MAX_S, STEP_HZ, WIND_RAMP_S, Pilot, Rates, Recording
from testbed.flight.multirotor_guidance import GENERATORS, TOUCHED_M, RotorSituation, guide
from testbed.flight.script import ABOUT_S, MOST_SAMPLES, Script, about, check_length
from testbed.flight.simulator import FOOT, IN_THE_AIR, KELVIN_PER_RANKINE, ON_WHEELS, Simulator

QUIET_MPS = 0.02
"""A hover has settled when it moves more slowly."""
TILT_LOST = math.radians(75.0)
"""Beyond it the rotors carry a quarter of the weight that they need: control is lost."""
BREEZE_MPS = 1.0
CRASH_M = 0.2
"""Over the height at which it stands: a flight that comes lower without landing has hit the ground."""


def fly_multirotor(config: FlightConfig, aircraft: Multirotor, folder: Path, seed: int) -> Recording:
    """Fly the whole script. Raises FlightError that names manoeuvre and time."""
    check_multirotor(config, aircraft)
    pilot = MultirotorPilot(config, aircraft, Simulator(config, aircraft, folder, 1.0 / STEP_HZ, seed))
    pilot.settle(config)
    return pilot.fly(config)


def check_multirotor(config: FlightConfig, aircraft: Multirotor) -> None:
    """Refuse what a multirotor cannot do before it takes off."""
    name, limits, wind = config.aircraft, aircraft.limits, config.wind
    if config.initial.speed_mps:
        raise FlightError(f"initial: '{name}' is a multirotor, which begins hovering or parked; remove speed_mps")
    if wind.turbulence != "none" and math.hypot(wind.north_mps, wind.east_mps) < BREEZE_MPS:
        raise FlightError(
            f"wind: JSBSim's gusts drift past at airspeed, and a hover in still air meets none; turbulence for '{name}' needs "
            f"a wind of at least {BREEZE_MPS:g} m/s (north_mps, east_mps)"
        )
    check_length(config, _expected_duration(config, aircraft))
    grounded = bool(config.initial.parked)
    speed = aircraft.autopilot.speed_nominal_mps
    for number, m in enumerate(config.manoeuvres, 1):
        place = f"manoeuvre {number} of {len(config.manoeuvres)} ({m.type})"
        if type(m) not in GENERATORS:
            can = ", ".join(sorted(cfg.manoeuvre_name(kind) for kind in GENERATORS))
            raise FlightError(f"{place}: '{name}' is a multirotor and cannot do this; it can do {can}")
        if grounded and not isinstance(m, cfg.Park | cfg.TakeOff):
            raise FlightError(f"{place}: '{name}' stands on the ground; take_off comes first")
        if not grounded and isinstance(m, cfg.Park | cfg.TakeOff):
            raise FlightError(f"{place}: it begins on the ground, but here '{name}' is in the air")
        if isinstance(m, cfg.Land) and not config.initial.parked:
            raise FlightError(f"{place}: only a flight that began parked knows its ground")
        grounded = isinstance(m, cfg.Park | cfg.Land)
        speed = _check_speeds(place, m, name, limits, m.speed_mps or speed)


def _check_speeds(place: str, m: cfg.AnyManoeuvre, name: str, limits: Any, speed: float) -> float:
    """Refuse speeds beyond the limits; the speed at the end of the manoeuvre."""
    speeds = [speed] + [p.speed_mps for p in getattr(m, "points", []) if p.speed_mps is not None]
    if max(speeds) > limits.speed_max_mps:
        raise FlightError(
            f"{place}: speed {max(speeds):g} m/s, but '{name}' flies at most {limits.speed_max_mps:g} m/s"
        )
    if isinstance(m, cfg.Loiter) and speed * speed / m.radius_m > limits.acceleration_mps2:
        raise FlightError(
            f"{place}: a circle of {m.radius_m:g} m at {speed:g} m/s needs {speed * speed / m.radius_m:.1f} m/s², but '{name}' "
            f"takes {limits.acceleration_mps2:g} m/s²"
        )
    climb = getattr(m, "climb_rate_mps", None) or 0.0
    down = isinstance(m, cfg.Descent) or climb < 0.0
    most = limits.descent_max_mps if down else limits.climb_max_mps
    if abs(climb) > most:
        raise FlightError(
            f"{place}: {abs(climb):g} m/s {'down' if down else 'up'}, but '{name}' does at most {most:g} m/s"
        )
    if getattr(m, "path_angle_deg", None) is not None:
        raise FlightError(f"{place}: a multirotor has no path angle; give climb_rate_mps")
    return speeds[-1]


def _expected_duration(config: FlightConfig, aircraft: Multirotor) -> float:
    """About how long the script takes, s."""
    total, speed, place = 0.0, aircraft.autopilot.speed_nominal_mps, (0.0, 0.0)
    for m in config.manoeuvres:
        speed = m.speed_mps or speed
        total += getattr(m, "duration_s", None) or ABOUT_S
        if isinstance(m, cfg.Loiter):
            total += 2.0 * math.pi * m.radius_m * (m.turns or 0.0) / speed
        for point in getattr(m, "points", []):
            to = about(point, config.initial)
            total += math.dist(place, to) / (point.speed_mps or speed) + (point.hold_s or 0.0)
            place = to
    return total


class MultirotorPilot(Pilot):
    """Cascade, guidance and recorder around one simulator."""

    def __init__(self, config: FlightConfig, aircraft: Multirotor, simulator: Simulator) -> None:
        self.rotor, self.simulator = aircraft, simulator
        self.rates = Rates(aircraft.autopilot.rate_hz)
        self.period = self.rates.period
        motors = aircraft.model.motors
        self.columns = (
            ("throttle", 1.0),
            *((f"motor_{k}", 1.0) for k in range(1, len(motors) + 1)),
            ("engine_rpm", aircraft.model.engine_scale),
            *((f"wind_{axis}_mps", FOOT) for axis in ("north", "east", "down")),
            ("temperature_k", KELVIN_PER_RANKINE),
        )
        self.desk = np.zeros(mk.DESK)
        self.measured, self.target, self.memory, self.command = desk_views(
            self.desk, mk.MEASUREMENTS, mk.TARGETS, mk.MEMORY
        )
        situation = RotorSituation(aircraft, memoryview(self.measured), self.target, self.memory)
        self.situation = self.hovering = situation
        self.guide = lambda manoeuvre: guide(manoeuvre, situation)
        self.gains = rotor_gains(aircraft, self.period, simulator.air_density())
        self.air = array("d")
        self.steps = 0
        self.parked_height = 0.0
        self.fast = self.rolling = False
        self._make_tick()

    def settle(self, config: FlightConfig) -> None:
        """Stand, or hover, until nothing moves; then some seconds in turbulence where there is any."""
        self.target[mk.HEADING] = math.radians(config.initial.heading_deg)
        self.target[mk.SPEED] = self.rotor.autopilot.speed_nominal_mps
        if config.initial.parked:
            self._stand()
        else:
            self._hover(config)
        if config.wind.turbulence != "none":
            self.simulator.turbulence_on()
            for _ in range(round(GUST_S / self.period)):
                self._run_tick()
        self.memory[mk.PLACE_NORTH] = self.memory[mk.PLACE_EAST] = 0.0
        del self.air[:]

    def _stand(self) -> None:
        under = self.simulator.undercarriage
        self.steps += under.settle(STEP_HZ)
        self.parked_height, self.rolling = under.parked_height, True
        self.hovering.on_ground = self.hovering.held_down = True
        self._look()
        self.simulator.set_wind(1.0)

    def _hover(self, config: FlightConfig) -> None:
        m, target = self.measured, self.target
        target[mk.STATE], target[mk.ALTITUDE] = mk.FLYING, config.initial.alt_m
        target[mk.CLIMB], target[mk.DESCENT] = self.rotor.limits.climb_max_mps, self.rotor.limits.descent_max_mps
        quiet = t = 0.0
        while quiet < 1.0:
            self.simulator.set_wind(min(1.0, t / WIND_RAMP_S))
            self._run_tick()
            t += self.period
            steady = math.hypot(m[mk.V_NORTH], m[mk.V_EAST], m[mk.V_DOWN]) < QUIET_MPS and t > WIND_RAMP_S
            quiet = quiet + self.period if steady else 0.0
            if t > SETTLE_MAX_S or not abs(m[mk.ROLL]) < TILT_LOST or not abs(m[mk.PITCH]) < TILT_LOST:
                raise FlightError(
                    f"'{config.aircraft}' finds no steady hover at {config.initial.alt_m:g} m: after {t:.0f} s it moves at "
                    f"{math.hypot(m[mk.V_NORTH], m[mk.V_EAST]):.1f} m/s and sinks {m[mk.V_DOWN]:.1f} m/s"
                )

    def rest(self, config: FlightConfig) -> cfg.AnyManoeuvre:
        """What a flight does that is longer than its script."""
        if isinstance(config.manoeuvres[-1], cfg.Park | cfg.Land):
            return cfg.Park(type="park", duration_s=200_000.0)
        return cfg.Hover(type="hover", duration_s=200_000.0)

    def _look(self) -> None:
        """Refresh what guidance sees, and let go or hold fast what it wants."""
        s, memory = self.hovering, self.memory
        s.north, s.east = float(memory[mk.PLACE_NORTH]), float(memory[mk.PLACE_EAST])
        s.v_north, s.v_east = float(self.measured[mk.V_NORTH]), float(self.measured[mk.V_EAST])
        s.over_ground = self.simulator.place[2]() * FOOT - self.parked_height
        if s.metres[0]:
            # a degree of longitude is that of the present latitude
            memory[mk.EAST_SCALE] = math.cos(s.origin[0]) / math.cos(s.origin[0] + s.north / s.metres[0]) - 1.0

    def _watch(self, script: Script) -> None:
        """FlightError when the multirotor has left what it can fly."""
        m, s = self.measured, self.hovering
        if not math.isfinite(sum(m.tolist())):
            script.fail("diverged: the state of the simulation is not finite")
        if max(abs(m[mk.ROLL]), abs(m[mk.PITCH])) > TILT_LOST:
            script.fail(
                f"lost control: it rolls {math.degrees(m[mk.ROLL]):.0f}°, pitches {math.degrees(m[mk.PITCH]):.0f}°"
            )
        landing = isinstance(script.manoeuvre, cfg.Land | cfg.Park | cfg.TakeOff)
        if not landing and s.over_ground < CRASH_M:
            script.fail("hit the ground")
        if s.t * script.config.rate_hz > MOST_SAMPLES:
            script.fail(f"flies on, beyond the {MOST_SAMPLES:.0e} samples that are kept")

    def _make_tick(self) -> None:
        """Read, act and record as closures over local names: attribute look-ups would double their cost."""
        sim, situation = self.simulator, self.hovering
        v_north, v_east, v_down, roll, pitch, yaw = sim.state
        p, q, r, _, _, _, height, _ = sim.motion
        engine, wind_n, wind_e, wind_d, temperature = sim.air[3:]
        over_ground = sim.place[2]
        desk: Any = self.desk
        gains, step, store = self.gains, mk.step, self.air.frombytes
        commands = memoryview(self.command)[: len(sim.motors)]
        motors = sim.motors
        pack, measured = struct.Struct(f"{mk.MEASUREMENTS}d").pack_into, memoryview(desk)
        pack_air = struct.Struct(f"{len(self.columns)}d").pack

        def read() -> None:
            pack(
                measured, 0, roll(), pitch(), yaw(), p(), q(), r(), v_north() * FOOT, v_east() * FOOT, v_down() * FOOT, height() * FOOT
            )  # fmt: skip

        def act() -> None:
            step(desk, gains)
            for turn, command in zip(motors, commands, strict=True):
                turn(command)
            near = over_ground() * FOOT - self.parked_height < TOUCHED_M
            if near is not self.rolling:
                self.rolling = near
                sim.integrate(ON_WHEELS if near else IN_THE_AIR)
            if situation.held_down is not self.fast:
                self.fast = situation.held_down
                sim.undercarriage.hold(self.fast)

        def record() -> None:
            values = commands.tolist()
            store(
                pack_air(
                    sum(values) / len(values), *values, engine(), wind_n(), wind_e(), wind_d(), temperature()
                )
            )  # fmt: skip

        self.read, self.act, self.record = read, act, record


def rotor_gains(aircraft: Multirotor, period: float, density: float) -> NDArray[np.float64]:
    """Gains and limits where the kernel looks for them; ``period`` is the time between ticks (s).

    ``density`` is that of the air over that at sea level: the thrust grows with it and with the square of the command.
    """
    a, limits = aircraft.autopilot, aircraft.limits
    out = np.zeros(mk.GAINS)
    out[mk.POSITION] = a.position
    out[mk.VELOCITY], out[mk.VELOCITY_INTEGRAL] = a.velocity, a.velocity_integral
    out[mk.ACCELERATION] = limits.acceleration_mps2
    out[mk.ATTITUDE], out[mk.RATE_LIMIT] = a.attitude, np.radians(a.rate_limit_dps)
    out[mk.RATE], out[mk.RATE_INTEGRAL_GAIN] = a.rate, a.rate_integral
    out[mk.HEADING_GAIN] = a.heading
    out[mk.YAW_RATE], out[mk.YAW_RATE_LIMIT] = a.yaw_rate, np.radians(a.yaw_rate_limit_dps)
    out[mk.HOVER] = a.hover_throttle / math.sqrt(density)
    out[mk.TILT_LIMIT] = np.radians(limits.tilt_max_deg)
    out[mk.PERIOD], out[mk.MOTORS] = period, len(aircraft.model.motors)
    for k, motor in enumerate(aircraft.model.motors):
        out[mk.MIXER + 3 * k : mk.MIXER + 3 * k + 3] = motor.roll, motor.pitch, motor.yaw
    return out
