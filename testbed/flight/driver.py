"""Fly a script: step JSBSim, tick the autopilot at 50 Hz and guidance at 10 Hz, sample the state, watch the limits.

JSBSim takes one step for all flights, whatever the rate of the truth: the turbulence is drawn per step, so a seed means
one flight.

The aircraft first settles in still air, level at its initial speed, with the wind set in slowly; then the turbulence
starts, and after some seconds of it time begins. SI units and radians.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import FlightError
from testbed.data.records import Phase
from testbed.flight import autopilot_kernels as ap
from testbed.flight import manoeuvres
from testbed.flight.aircraft import Aircraft
from testbed.flight.autopilot import gain_array
from testbed.flight.config import FlightConfig
from testbed.flight.manoeuvre_config import AnyManoeuvre, Land, Park, Straight
from testbed.flight.script import FEWEST_SAMPLES, GENERATORS, MOST_SAMPLES, Guide, Script, check_script, script_duration
from testbed.flight.simulator import FOOT, IN_THE_AIR, KELVIN_PER_RANKINE, ON_WHEELS, STATE, Simulator
from testbed.flight.truth import Resampler
from testbed.flight.undercarriage import Undercarriage
from testbed.physics.earth import metres_per_radian

STEP_HZ = 400.0
"""Steps of JSBSim per second. The aerosonde's roll mode (33 ms) is resolved by 13; in turbulence the specific force is
within 1 % of that at 800 Hz, at 200 Hz within 3 % (six seeds)."""
FLUSH = 1 << 14
"""Steps that are kept before they go to the splines: the memory of a flight does not grow with its knots."""
GUIDANCE_HZ, AIR_HZ = 10.0, 25.0
GROUND_M = 1.0
"""Below this height over ground the aircraft has hit it."""
WHEELS_M = 2.0
"""Wheels this low: integration as they need it, from the tick of guidance (0.1 s) before they touch at the latest."""
TIPPED = math.radians(25.0)
STALL_TICKS, LAG_TICKS = 5, 200
"""Guidance ticks (0.1 s) beyond the stall, or far from a target, after which the flight has failed."""
SETTLE_MIN_S, SETTLE_MAX_S, WIND_RAMP_S, GUST_S = 8.0, 90.0, 6.0, 5.0
AIR = (
    ("airspeed_mps", FOOT),
    ("alpha_deg", math.degrees(1.0)),
    ("beta_deg", math.degrees(1.0)),
    ("throttle", 1.0),
    ("aileron", 1.0),
    ("elevator", 1.0),
    ("rudder", 1.0),
    ("engine_rpm", 1.0),
    ("wind_north_mps", FOOT),
    ("wind_east_mps", FOOT),
    ("wind_down_mps", FOOT),
    ("temperature_k", KELVIN_PER_RANKINE),
)
"""Extra columns as recorded at each tick of the autopilot, with the factor to their unit."""


@dataclass
class Recording:
    """What a flight leaves: velocity and attitude at the truth's rate, air data, phases, and where time began."""

    v_n: NDArray[np.float64]
    q_nb: NDArray[np.float64]
    air_t: NDArray
    air: NDArray[np.float64]
    phases: tuple[Phase, ...]
    start: tuple[float, float, float]
    steps: int
    """JSBSim steps taken, settling included."""
    air_names: tuple[str, ...] = tuple(name for name, _ in AIR)


class Rates:
    """How often what happens: steps of JSBSim per tick of the autopilot, ticks per guidance and per sample of the air."""

    def __init__(self, control_hz: float) -> None:
        self.steps = round(STEP_HZ / control_hz)
        self.guidance, self.air = round(control_hz / GUIDANCE_HZ), round(control_hz / AIR_HZ)
        self.period = self.steps / STEP_HZ


def fly_script(config: FlightConfig, aircraft: Aircraft, folder: Path, seed: int) -> Recording:
    """Fly the whole script. Raises FlightError that names manoeuvre and time."""
    check_script(config, aircraft)
    pilot = Pilot(config, aircraft, Simulator(config, aircraft, folder, 1.0 / STEP_HZ, seed))
    if config.initial.parked:
        pilot.park(config)
    else:
        pilot.settle(config)
    return pilot.fly(config)


def steps_per_sample(rate_hz: float, steps_per_control: int) -> int:
    """Steps of JSBSim between two samples of its state: as many as lie between two rows of the truth, where that is a part of
    the autopilot's tick; else as many as make a tick where that divides them, and the rows lie on samples or between."""
    stride = round(STEP_HZ / rate_hz)
    whole = stride >= 1 and math.isclose(stride * rate_hz, STEP_HZ, rel_tol=1e-12)
    return math.gcd(stride, steps_per_control) if whole else 1


class Pilot:
    """Autopilot, guidance and recorder around one simulator."""

    columns: tuple[tuple[str, float], ...] = AIR

    def __init__(self, config: FlightConfig, aircraft: Aircraft, simulator: Simulator) -> None:
        self.aircraft, self.simulator = aircraft, simulator
        self.rates = Rates(aircraft.autopilot.rate_hz)
        self.period = self.rates.period
        self.desk = np.zeros(ap.DESK)
        self.measured, self.target, self.memory, self.command = ap.desk_views(
            self.desk, ap.MEASUREMENTS, ap.TARGETS, ap.MEMORY
        )
        self.memory[ap.SPEED_REFERENCE] = config.initial.speed_mps
        self.memory[ap.PITCH_INTEGRAL] = aircraft.autopilot.elevator_trim
        # a memory view gives plain numbers, in a third of the time that an element of a numpy array takes
        self.wanted, self.held = memoryview(self.target), memoryview(self.memory)
        situation = manoeuvres.Situation(aircraft, memoryview(self.measured), self.target)
        self.situation: manoeuvres.Journey = situation
        self.flying = situation
        self.guide: Guide = lambda manoeuvre: manoeuvres.guide(manoeuvre, situation, GENERATORS[type(manoeuvre)])
        self.wheels = simulator.undercarriage if config.initial.parked else None
        situation.undercarriage = self.wheels
        self.on_wheels = config.initial.parked
        self.air = array("d")
        self.read, self.act, self.record = _make_tick(self)
        self.steps = 0
        self.stalled, self.lagging = 0, 0
        self.roll_departed = math.radians(aircraft.limits.bank_max_deg + 45.0)
        self.alpha_stall = math.radians(aircraft.limits.alpha_stall_deg)
        self.speed_stall = 0.75 * aircraft.limits.speed_min_mps
        self.height_over_ground = simulator.place[2]

    def settle(self, config: FlightConfig) -> None:
        """Fly straight and level until nothing moves; then some seconds in turbulence where there is any."""
        target, measured, limits = self.target, self.measured, self.aircraft.limits
        target[ap.LATERAL_MODE], target[ap.HEADING] = ap.HOLD_HEADING, math.radians(config.initial.heading_deg)
        target[ap.BANK_LIMIT] = math.radians(20.0)
        target[ap.ALTITUDE] = config.initial.alt_m
        target[ap.SPEED], target[ap.ACCELERATION] = config.initial.speed_mps, limits.acceleration_mps2
        tolerance = 0.002 * config.initial.speed_mps
        period = self.period
        quiet = 0.0
        t = 0.0
        while t < SETTLE_MIN_S or quiet < 1.0:
            if t > SETTLE_MAX_S:
                break
            if t < SETTLE_MIN_S:
                self.simulator.set_wind(min(1.0, t / WIND_RAMP_S))
            self._run_tick()
            t += period
            steady = abs(measured[ap.AIRSPEED] - config.initial.speed_mps) < tolerance
            steady = steady and abs(measured[ap.CLIMB_RATE]) < tolerance and abs(measured[ap.ROLL]) < 0.005
            quiet = quiet + period if steady else 0.0
            if not abs(measured[ap.ROLL]) < math.pi / 2:
                break
        if quiet < 1.0:
            raise FlightError(
                f"'{config.aircraft}' finds no steady level flight at {config.initial.speed_mps:g} m/s and "
                f"{config.initial.alt_m:g} m: after {t:.0f} s it flies {measured[ap.AIRSPEED]:.1f} m/s, "
                f"climbs {measured[ap.CLIMB_RATE]:.1f} m/s, banks {math.degrees(measured[ap.ROLL]):.0f}°"
            )
        if config.wind.turbulence != "none":
            self.simulator.turbulence_on()
            for _ in range(round(GUST_S / period)):
                self._run_tick()
        del self.air[:]

    def park(self, config: FlightConfig) -> None:
        """Let the aircraft come to rest on its wheels and hold it there; then the wind and its gusts begin."""
        wheels = self.simulator.undercarriage
        try:
            self.steps += wheels.settle(STEP_HZ)
        except FlightError as error:
            raise FlightError(f"'{config.aircraft}': {error}") from None
        wheels.hold(True)
        self.target[ap.VERTICAL_MODE], self.target[ap.THROTTLE_MODE] = ap.HANDS_OFF, ap.BY_HAND
        self.simulator.set_wind(1.0)
        if config.wind.turbulence != "none":
            self.simulator.turbulence_on()
        # what moved until it was held is not part of the flight
        for _ in range(self.rates.steps):
            self.simulator.run()

    def fly(self, config: FlightConfig) -> Recording:
        """Fly the manoeuvres and record."""
        duration = script_duration(config)
        samples = None if duration is None else round(duration * config.rate_hz) + 1
        s, run = self.situation, self.simulator.run
        origin = math.radians(config.initial.lat_deg), math.radians(config.initial.lon_deg)
        s.origin = (*origin, config.initial.alt_m)
        s.metres = metres_per_radian(s.origin[0], s.origin[2])
        start = *origin, self.simulator.motion[6]() * FOOT
        rates = self.rates
        stride = steps_per_sample(config.rate_hz, rates.steps)
        truth = Resampler(STEP_HZ / stride, config.rate_hz)
        script = Script(config, s, self.guide, self.rest(config))
        v_n, v_e, v_d, roll, pitch, yaw = self.simulator.state
        # a row is packed before it is stored: an array that is extended by a tuple takes twice as long
        pack, state = struct.Struct(f"{len(STATE)}d").pack, array("d")
        store = state.frombytes
        store(pack(v_n(), v_e(), v_d(), roll(), pitch(), yaw()))
        read, act, record = self.read, self.act, self.record
        step, ticks = 0, 0
        samples_per_tick = ((run,) * stride,) * (rates.steps // stride)
        last = (
            None if samples is None else max(FEWEST_SAMPLES, math.ceil((samples - 1) * STEP_HZ / config.rate_hz - 1e-6))
        )
        # this loop is the whole cost of flying beside JSBSim itself
        while last is None or step < last:
            read()
            if ticks % rates.guidance == 0:
                s.t = round(step / STEP_HZ, 9)
                self._look()
                self._watch(script)
                if not script.advance(open_ended=last is not None):
                    break
            act()
            if ticks % rates.air == 0:
                record()
            ticks += 1
            step += rates.steps
            for steps in samples_per_tick:
                for take_step in steps:
                    take_step()
                store(pack(v_n(), v_e(), v_d(), roll(), pitch(), yaw()))
            if len(state) > FLUSH * len(STATE):
                _hand_over(state, truth)
        self.steps += step
        _hand_over(state, truth)
        flown_v_n, flown_q_nb = truth.finish()
        flown_v_n, flown_q_nb = flown_v_n[:samples], flown_q_nb[:samples]
        air = np.frombuffer(self.air).reshape(-1, len(self.columns))
        air *= np.array([factor for _, factor in self.columns])
        return Recording(
            flown_v_n,
            flown_q_nb,
            np.arange(len(air)) * rates.air * self.period,
            air,
            script.phases((len(flown_v_n) - 1) / config.rate_hz),
            start,
            self.steps,
            tuple(name for name, _ in self.columns),
        )

    def rest(self, config: FlightConfig) -> AnyManoeuvre:
        """What a flight does that is longer than its script."""
        if isinstance(config.manoeuvres[-1], Park | Land):
            return Park(type="park", duration_s=200_000.0)
        return Straight(type="straight", duration_s=200_000.0)

    def _run_tick(self) -> None:
        self.read()
        self.act()
        for _ in range(self.rates.steps):
            self.simulator.run()
        self.steps += self.rates.steps

    def _look(self) -> None:
        """Refresh what guidance sees beside the measurements of the autopilot.

        The place is that of the truth, which begins where the scenario says: the integral of the velocity by the trapezoid
        rule, which is exact to (0.1 s)²/12 of the change of acceleration, centimetres.
        """
        s, sim = self.flying, self.simulator
        v_north, v_east = sim.state[0]() * FOOT, sim.state[1]() * FOOT
        if s.t > 0.0:
            half = 0.5 * self.rates.guidance * self.period
            s.north += half * (s.v_north + v_north)
            # a degree of longitude is that of the present latitude
            cosine = math.cos(s.origin[0]) / math.cos(s.origin[0] + s.north / s.metres[0])
            s.east += half * (s.v_east + v_east) * cosine
        s.v_north, s.v_east = v_north, v_east
        if self.wheels is not None:
            s.throttle = float(self.command[ap.THROTTLE])
            near = self.wheels.height() < WHEELS_M
            if near != self.on_wheels:
                self.on_wheels = near
                sim.integrate(ON_WHEELS if near else IN_THE_AIR)

    def _watch(self, script: Script) -> None:
        """FlightError when the aircraft has left what it can fly."""
        m = self.measured.tolist()
        roll, alpha, airspeed = m[ap.ROLL], m[ap.ALPHA], m[ap.AIRSPEED]
        if self.situation.t * script.config.rate_hz > MOST_SAMPLES:
            script.fail(f"flies on, beyond the {MOST_SAMPLES:.0e} samples that are kept")
        if not math.isfinite(sum(m)):
            script.fail("diverged: the state of the simulation is not finite")
        if self.flying.low and self.wheels is not None:
            self._watch_wheels(script, self.wheels)
            return
        if self.height_over_ground() < GROUND_M / FOOT:
            script.fail(f"hit the ground at {airspeed:.0f} m/s")
        if abs(roll) > self.roll_departed:
            script.fail(f"departed: it banks {math.degrees(roll):.0f}°")
        self.stalled = self.stalled + 1 if alpha > self.alpha_stall or airspeed < self.speed_stall else 0
        if self.stalled > STALL_TICKS:
            script.fail(f"stalled: incidence {math.degrees(alpha):.0f}°, airspeed {airspeed:.1f} m/s")
        what = self._behind(m)
        self.lagging = self.lagging + 1 if what else 0
        if self.lagging > LAG_TICKS:
            script.fail(f"could not hold {what}")

    def _watch_wheels(self, script: Script, wheels: Undercarriage) -> None:
        """FlightError when the aircraft tips over, or comes down on something else than its wheels."""
        roll, pitch = self.measured[ap.ROLL], self.measured[ap.PITCH]
        if max(abs(roll), abs(pitch - wheels.parked_pitch)) > TIPPED:
            script.fail(f"tips over: pitch {math.degrees(pitch):.0f}°, bank {math.degrees(roll):.0f}°")
        if wheels.strikes():
            speed = math.hypot(self.situation.v_north, self.situation.v_east)
            script.fail(f"touches the ground with more than its wheels, at {speed:.0f} m/s: is the wind from behind?")

    def _behind(self, m: list[float]) -> str:
        """Which vertical or speed target is far away, or nothing."""
        target, climb_rate = self.wanted, m[ap.CLIMB_RATE]
        if target[ap.VERTICAL_MODE] == ap.HOLD_CLIMB:
            wanted = target[ap.CLIMB]
            if abs(climb_rate - wanted) > 1.5 + 0.4 * abs(wanted):
                return f"a climb rate of {wanted:.1f} m/s (it climbs {climb_rate:.1f} m/s)"
        else:
            miss = m[ap.HEIGHT] - target[ap.ALTITUDE]
            if miss * climb_rate > 0.0 and abs(miss) > 20.0 * self.aircraft.limits.climb_max_mps:
                return f"its height of {target[ap.ALTITUDE]:.0f} m (it is at {m[ap.HEIGHT]:.0f} m)"
        reference = self.held[ap.SPEED_REFERENCE]
        if abs(m[ap.AIRSPEED] - reference) > 0.25 * reference:
            return f"a speed of {reference:.1f} m/s (it flies {m[ap.AIRSPEED]:.1f} m/s)"
        return ""


def _hand_over(state: array[float], truth: Resampler) -> None:
    """Give the recorded steps to the splines and forget them."""
    rows = np.frombuffer(state).reshape(-1, len(STATE)) * np.array([factor for _, factor in STATE])
    truth.add(rows[:, :3], rows[:, 3:])
    del state[:]


def _make_tick(pilot: Pilot) -> tuple[Callable[[], None], Callable[[], None], Callable[[], None]]:
    """Read, act and record as closures over local names: attribute look-ups would double their cost."""
    sim = pilot.simulator
    p, q, r, airspeed, alpha, beta, height, climb = sim.motion
    roll, pitch, yaw = sim.state[3:]
    left_aileron, elevator, rudder, engine, wind_n, wind_e, wind_d, temperature = sim.air
    set_aileron, set_elevator, set_rudder, set_nose_wheel = sim.surfaces
    throttles = sim.throttles
    desk: Any = pilot.desk
    command = memoryview(pilot.command)
    gains, step, store = gain_array(pilot.aircraft, pilot.period), ap.step, pilot.air.frombytes
    pack_air = struct.Struct(f"{len(AIR)}d").pack
    scale = pilot.aircraft.model.engine_scale
    pack, measured = struct.Struct(f"{ap.MEASUREMENTS}d").pack_into, memoryview(desk)

    def read() -> None:
        pack(
            measured, 0, roll(), pitch(), yaw(), p(), q(), r(), airspeed() * FOOT, alpha(), beta(), height() * FOOT, climb() * FOOT
        )  # fmt: skip

    def act() -> None:
        step(desk, gains)
        one, two, three, four, five = command.tolist()
        set_aileron(one)
        set_elevator(two)
        set_rudder(three)
        for set_throttle in throttles:
            set_throttle(four)
        set_nose_wheel(five)

    def record() -> None:
        store(
            pack_air(
                airspeed(), alpha(), beta(), command[ap.THROTTLE], left_aileron(), elevator(), rudder(),
                engine() * scale, wind_n(), wind_e(), wind_d(), temperature()
            )
        )  # fmt: skip

    return read, act, record
