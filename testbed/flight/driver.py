"""Fly a script: step JSBSim, tick the autopilot at about 50 Hz and guidance at 10 Hz, sample the state, watch the limits.

The aircraft first settles in still air, level at its initial speed, with the wind set in slowly; then the turbulence
starts, and after some seconds of it time begins. SI units and radians.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from testbed.errors import FlightError, TestbedError
from testbed.flight import autopilot_kernels as ap
from testbed.flight import manoeuvres
from testbed.flight.aircraft import Aircraft, gain_array
from testbed.flight.config import FlightConfig, Straight
from testbed.flight.simulator import FOOT, KELVIN_PER_RANKINE, STATE, Simulator
from testbed.records import Phase

STEP_RATE_MIN = 200.0
"""JSBSim steps at least this often: the aerosonde's roll mode has a time constant of 33 ms."""
CONTROL_RATE = 50.0
CONTROLS_PER_GUIDANCE = 5
SETTLE_MIN_S, SETTLE_MAX_S, GUST_S = 8.0, 90.0, 5.0
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
    """What a flight leaves: state at the IMU rate, air data at the control rate, phases, and where time began."""

    state: NDArray[np.float64]
    air_t: NDArray[np.float64]
    air: NDArray[np.float64]
    phases: tuple[Phase, ...]
    start: tuple[float, float, float]
    steps: int
    """JSBSim steps taken, settling included."""


def fly_script(config: FlightConfig, aircraft: Aircraft, folder: Path, seed: int) -> Recording:
    """Fly the whole script. Raises FlightError that names manoeuvre and time."""
    check_script(config, aircraft)
    substeps = math.ceil(STEP_RATE_MIN / config.rate_hz - 1e-9)
    dt = 1.0 / (config.rate_hz * substeps)
    pilot = _Pilot(config, aircraft, Simulator(config, aircraft, folder, dt, seed), dt)
    pilot.settle(config)
    return pilot.fly(config, substeps)


def script_duration(config: FlightConfig) -> float | None:
    """Length of the flight (s) where the script fixes it, else None."""
    if config.duration_s is not None:
        return config.duration_s
    durations = [getattr(m, "duration_s", None) for m in config.manoeuvres]
    return None if None in durations else float(sum(durations))  # type: ignore[arg-type]


def check_script(config: FlightConfig, aircraft: Aircraft) -> None:
    """Refuse what the aircraft cannot do before it takes off: speeds, bank angles and radii beyond its limits."""
    limits = aircraft.limits
    low, high = limits.speed_min_mps, limits.speed_max_mps
    speed = config.initial.speed_mps
    if not low <= speed <= high:
        raise FlightError(f"initial: speed {speed:g} m/s, but '{config.aircraft}' flies {low:g} to {high:g} m/s")
    for number, m in enumerate(config.manoeuvres, 1):
        place = f"manoeuvre {number} of {len(config.manoeuvres)} ({m.type})"
        wanted = getattr(m, "to_speed_mps", None) or m.speed_mps
        if wanted is not None:
            if not low <= wanted <= high:
                raise FlightError(f"{place}: speed {wanted:g} m/s, but '{config.aircraft}' flies {low:g} to {high:g} m/s")
            speed = wanted
        bank = abs(getattr(m, "bank_deg", 0.0))
        if (radius := getattr(m, "radius_m", None)) is not None and m.type == "loiter":
            bank = math.degrees(math.atan(speed * speed / (9.81 * radius)))
        load = 1.0 / math.cos(math.radians(bank))
        if bank > limits.bank_max_deg or load > limits.load_factor_max:
            raise FlightError(
                f"{place}: needs {bank:.0f}° of bank and {load:.1f} g at {speed:g} m/s, but '{config.aircraft}' stands "
                f"{limits.bank_max_deg:g}° and {limits.load_factor_max:g} g"
            )


class _Pilot:
    """Autopilot, guidance and recorder around one simulator."""

    def __init__(self, config: FlightConfig, aircraft: Aircraft, simulator: Simulator, dt: float) -> None:
        self.aircraft, self.simulator, self.dt = aircraft, simulator, dt
        self.every = max(1, round(1.0 / (dt * CONTROL_RATE)))
        self.measured, self.target = np.zeros(ap.MEASUREMENTS), np.zeros(ap.TARGETS)
        self.memory, self.command = np.zeros(ap.MEMORY), np.zeros(4)
        self.memory[ap.SPEED_REFERENCE] = config.initial.speed_mps
        self.memory[ap.PITCH_INTEGRAL] = aircraft.autopilot.elevator_trim
        self.situation = manoeuvres.Situation(aircraft, self.measured, self.target)
        self.air = array("d")
        self.tick = _make_tick(self)
        self.steps = 0
        self.trouble = 0
        self.lagging = 0

    def settle(self, config: FlightConfig) -> None:
        """Fly straight and level until nothing moves; then some seconds in turbulence where there is any."""
        target, measured, limits = self.target, self.measured, self.aircraft.limits
        self._look()
        target[ap.LATERAL_MODE], target[ap.HEADING] = ap.HOLD_HEADING, math.radians(config.initial.heading_deg)
        target[ap.BANK_LIMIT] = math.radians(20.0)
        target[ap.ALTITUDE] = config.initial.alt_m
        target[ap.SPEED], target[ap.ACCELERATION] = config.initial.speed_mps, limits.acceleration_mps2
        tolerance = 0.002 * config.initial.speed_mps
        period = self.every * self.dt
        quiet = 0.0
        t = 0.0
        while t < SETTLE_MIN_S or quiet < 1.0:
            if t > SETTLE_MAX_S:
                break
            self.simulator.set_wind(min(1.0, t / (0.7 * SETTLE_MIN_S)))
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

    def fly(self, config: FlightConfig, substeps: int) -> Recording:
        """Fly the manoeuvres and record."""
        duration = script_duration(config)
        samples = None if duration is None else round(duration * config.rate_hz) + 1
        s, sim, run = self.situation, self.simulator, self.simulator.run
        lat, lon, _ = sim.place
        s.origin = (lat(), lon(), config.initial.alt_m)
        start = (math.radians(config.initial.lat_deg), math.radians(config.initial.lon_deg), sim.motion[6]() * FOOT)
        script = _Script(config, s)
        v_n, v_e, v_d, roll, pitch, yaw = sim.state
        state = array("d", (v_n(), v_e(), v_d(), roll(), pitch(), yaw()))
        store, every, dt, tick = state.extend, self.every, self.dt, self.tick
        step, following, ticks = 0, substeps, 0
        last = None if samples is None else (samples - 1) * substeps
        # this loop is the whole cost of flying beside JSBSim itself
        while True:
            if ticks % CONTROLS_PER_GUIDANCE == 0:
                self._look()
                s.t = step * dt
                self._watch(script)
                if not script.advance(open_ended=last is not None):
                    break
            tick()
            ticks += 1
            for _ in range(every):
                run()
                step += 1
                if step == following:
                    store((v_n(), v_e(), v_d(), roll(), pitch(), yaw()))
                    following += substeps
            if last is not None and step >= last:
                break
        self.steps += step
        rows = np.frombuffer(state).reshape(-1, len(STATE))[:samples]
        end = (len(rows) - 1) / config.rate_hz
        scale = np.array([factor for _, factor in STATE])
        air = np.frombuffer(self.air).reshape(-1, len(AIR)) * np.array([factor for _, factor in AIR])
        return Recording(rows * scale, np.arange(len(air)) * every * dt, air, script.phases(end), start, self.steps)

    def _run_tick(self) -> None:
        self.tick()
        for _ in range(self.every):
            self.simulator.run()
        self.steps += self.every

    def _look(self) -> None:
        """Refresh what guidance sees."""
        s, sim = self.situation, self.simulator
        lat, lon = sim.place[0](), sim.place[1]()
        north, east = _metres(s.origin)
        s.north, s.east = (lat - s.origin[0]) * north, manoeuvres.wrap(lon - s.origin[1]) * east
        s.v_north, s.v_east = sim.state[0]() * FOOT, sim.state[1]() * FOOT
        self.read()

    def read(self) -> None:
        """Refresh the measurements of the autopilot."""

    def _watch(self, script: _Script) -> None:
        """FlightError when the aircraft has left what it can fly."""
        m, limits, s = self.measured, self.aircraft.limits, self.situation
        if not np.isfinite(m).all():
            script.fail("the simulation diverged (state is not finite)")
        if self.simulator.place[2]() * FOOT < 1.0:
            script.fail(f"hit the ground at {m[ap.AIRSPEED]:.0f} m/s")
        if abs(m[ap.ROLL]) > math.radians(limits.bank_max_deg + 45.0):
            script.fail(f"departed: it banks {math.degrees(m[ap.ROLL]):.0f}°")
        stalled = m[ap.ALPHA] > math.radians(limits.alpha_stall_deg) or m[ap.AIRSPEED] < 0.75 * limits.speed_min_mps
        self.trouble = self.trouble + 1 if stalled else 0
        if self.trouble > 5:
            script.fail(f"stalled: incidence {math.degrees(m[ap.ALPHA]):.0f}°, airspeed {m[ap.AIRSPEED]:.1f} m/s")
        behind, what = _behind(m, self.target, self.memory, limits.climb_max_mps)
        self.lagging = self.lagging + 1 if behind else 0
        if self.lagging > 200:
            script.fail(f"could not hold {what} for 20 s")
        s.begin = s.begin  # planned times are kept by the script


def _behind(m: NDArray, target: NDArray, memory: NDArray, climb_max: float) -> tuple[bool, str]:
    """Whether the aircraft is far from its vertical or speed target, and how."""
    if target[ap.VERTICAL_MODE] == ap.HOLD_CLIMB:
        wanted = target[ap.CLIMB]
        if abs(m[ap.CLIMB_RATE] - wanted) > 2.0 + 0.5 * abs(wanted):
            return True, f"a climb rate of {wanted:.1f} m/s (it climbs {m[ap.CLIMB_RATE]:.1f} m/s)"
    elif abs(miss := m[ap.HEIGHT] - target[ap.ALTITUDE]) > 20.0 * climb_max and miss * m[ap.CLIMB_RATE] > 0.0:
        return True, f"its height of {target[ap.ALTITUDE]:.0f} m (it is at {m[ap.HEIGHT]:.0f} m)"
    reference = memory[ap.SPEED_REFERENCE]
    if abs(m[ap.AIRSPEED] - reference) > 0.25 * reference:
        return True, f"a speed of {reference:.1f} m/s (it flies {m[ap.AIRSPEED]:.1f} m/s)"
    return False, ""


def _metres(origin: tuple[float, float, float]) -> tuple[float, float]:
    from testbed.earth import metres_per_radian

    return metres_per_radian(origin[0], origin[2])


class _Script:
    """Goes through the manoeuvres, keeps their phases, and names the current one in errors."""

    def __init__(self, config: FlightConfig, situation: manoeuvres.Situation) -> None:
        self.config, self.s = config, situation
        self.number = 0
        self.current: Iterator[None] | None = None
        self.begins: list[float] = []
        self.labels: list[str] = []

    @property
    def _now(self) -> str:
        total = len(self.config.manoeuvres)
        if self.number > total:
            return f"after manoeuvre {total} of {total} (straight)"
        return f"manoeuvre {self.number} of {total} ({self.config.manoeuvres[self.number - 1].type})"

    def fail(self, what: str) -> None:
        """Raise FlightError with place and time."""
        raise FlightError(f"{self._now} at t = {self.s.t:.1f} s: '{self.config.aircraft}' {what}")

    def advance(self, open_ended: bool) -> bool:
        """One guidance tick; False when the script is over and the flight may end."""
        while True:
            try:
                if self.current is not None:
                    next(self.current)
                    return True
            except StopIteration:
                self.current = None
            except TestbedError as error:
                self.fail(str(error))
            if self.number >= len(self.config.manoeuvres):
                if not open_ended:
                    return False
                self._begin(Straight(type="straight", duration_s=200_000.0))
            else:
                self._begin(self.config.manoeuvres[self.number])

    def _begin(self, manoeuvre: object) -> None:
        self.number += 1
        self.current = manoeuvres.guide(manoeuvre, self.s)  # type: ignore[arg-type]
        self.begins.append(self.s.begin)
        self.labels.append(manoeuvre.label)  # type: ignore[attr-defined]

    def phases(self, end: float) -> tuple[Phase, ...]:
        """One phase per manoeuvre, cut at the end of the flight."""
        stops = [*self.begins[1:], end]
        pairs = zip(self.labels, self.begins, stops, strict=True)
        return tuple(Phase(label, begin, min(stop, end)) for label, begin, stop in pairs if begin < end)


def _make_tick(pilot: _Pilot) -> Callable[[], None]:
    """The autopilot tick as a closure over local names: attribute look-ups would double its cost."""
    sim = pilot.simulator
    p, q, r, airspeed, alpha, beta, height, climb = sim.motion
    roll, pitch, yaw = sim.state[3:]
    left_aileron, elevator, rudder, engine, wind_n, wind_e, wind_d, temperature = sim.air
    set_aileron, set_elevator, set_rudder = sim.surfaces
    throttles = sim.throttles
    measured, target, memory, command = pilot.measured, pilot.target, pilot.memory, pilot.command
    gains, period, step, record = gain_array(pilot.aircraft), pilot.every * pilot.dt, ap.step, pilot.air.extend
    scale = pilot.aircraft.model.engine_scale

    def read() -> None:
        measured[0], measured[1], measured[2] = roll(), pitch(), yaw()
        measured[3], measured[4], measured[5] = p(), q(), r()
        measured[6], measured[7], measured[8] = airspeed() * FOOT, alpha(), beta()
        measured[9], measured[10] = height() * FOOT, climb() * FOOT

    def tick() -> None:
        measured[0], measured[1], measured[2] = roll(), pitch(), yaw()
        measured[3], measured[4], measured[5] = p(), q(), r()
        v, a, b = airspeed(), alpha(), beta()
        measured[6], measured[7], measured[8] = v * FOOT, a, b
        measured[9], measured[10] = height() * FOOT, climb() * FOOT
        step(measured, target, gains, memory, command, period)
        one, two, three, four = command.tolist()
        set_aileron(one)
        set_elevator(two)
        set_rudder(three)
        for set_throttle in throttles:
            set_throttle(four)
        record(
            (v, a, b, four, left_aileron(), elevator(), rudder(), engine() * scale)
            + (wind_n(), wind_e(), wind_d(), temperature())
        )

    pilot.read = read  # type: ignore[method-assign]
    return tick
