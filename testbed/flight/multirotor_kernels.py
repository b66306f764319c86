"""The autopilot of a multirotor: a cascade from place over velocity and attitude to body rates, mixed onto the motors.

Structure after Beard and McLain's notes on multirotors and Mahony, Kumar and Corke, *Multirotor Aerial Vehicles*, IEEE RAM
19(3), 2012: the thrust points where the wanted acceleration does, so horizontal motion is a tilt. Frames n and b, SI units
and radians.

`step` is one tick. As in `autopilot_kernels` its arrays are views of one array, the desk, indexed by the names below.
"""

from __future__ import annotations

import numpy as np

from testbed.flight.autopilot_kernels import clip, desk_views
from testbed.kernels import njit
from testbed.physics.earth import G0
from testbed.physics.rotations import wrap

# measurements
ROLL, PITCH, YAW, P, Q, R, V_NORTH, V_EAST, V_DOWN, HEIGHT = range(10)
MEASUREMENTS = 10

# targets
STATE, MODE, NORTH, EAST, COURSE, ALTITUDE, SPEED, CLIMB, DESCENT, HEADING, RADIUS, SIDE = range(12)
TARGETS = 12
MOTORS_OFF, ON_GROUND, FLYING = 0.0, 1.0, 2.0
TO_POINT, CIRCLE = 0.0, 1.0
"""Modes: along the line of a course to a point, and to hover there; round a point."""

# memory
PLACE_NORTH, PLACE_EAST, LAST_NORTH, LAST_EAST, EAST_SCALE = range(5)
"""The last is what a metre east counts at the start's latitude, less one."""
WANTED, INTEGRAL, RATE_INTEGRAL = 5, 8, 11
"""Three numbers each: the velocity reference, the integrals of its error and of that of the body rates."""
MEMORY = 14

# commands: one per motor
MOST_MOTORS = 16
DESK = MEASUREMENTS + TARGETS + MEMORY + MOST_MOTORS

# gains and limits, then the mixer: roll, pitch and yaw of each motor
(
    POSITION,
    VELOCITY,
    VELOCITY_INTEGRAL,
    ACCELERATION,
    ATTITUDE,
    RATE_LIMIT,
    RATE,
    RATE_INTEGRAL_GAIN,
    HEADING_GAIN,
    YAW_RATE,
    YAW_RATE_LIMIT,
    HOVER,
    TILT_LIMIT,
    PERIOD,
    MOTORS,
) = range(15)
MIXER = 15
GAINS = MIXER + 3 * MOST_MOTORS

INTEGRAL_LIMIT = 3.0
"""m/s²: what wind, and air that is thinner than at the start, may need beside the feedback."""
RATE_INTEGRAL_LIMIT = 0.1
"""Of the command: motors that differ."""


@njit(cache=True)
def step(desk, gain):
    """One tick of ``gain[PERIOD]`` seconds: keeps the place, fills the commands, advances the memory."""
    m, target, memory, command = desk_views(desk, MEASUREMENTS, TARGETS, MEMORY)
    dt = gain[PERIOD]
    # the truth's place is the integral of the velocity, not JSBSim's place; trapezoids of 5 ms are exact to micrometres
    memory[PLACE_NORTH] += 0.5 * dt * (memory[LAST_NORTH] + m[V_NORTH])
    memory[PLACE_EAST] += 0.5 * dt * (memory[LAST_EAST] + m[V_EAST]) * (1.0 + memory[EAST_SCALE])
    memory[LAST_NORTH], memory[LAST_EAST] = m[V_NORTH], m[V_EAST]
    if target[STATE] == MOTORS_OFF:
        memory[WANTED:] = 0.0
        command[:] = 0.0
        return
    acceleration, heading, turn = _guide(m, target, gain, memory, dt)
    thrust, tilt = _tilt(m, gain, acceleration)
    torque = _turn(m, gain, memory, tilt, (heading, turn), target[STATE] == FLYING)
    base = gain[HOVER] * np.sqrt(max(0.05, thrust))
    for k in range(int(gain[MOTORS])):
        mix = MIXER + 3 * k
        wanted = base + gain[mix] * torque[0] + gain[mix + 1] * torque[1] + gain[mix + 2] * torque[2]
        command[k] = clip(wanted, 0.0, 1.0)


@njit(cache=True)
def approach(distance, gain, acceleration):
    """Speed at a distance from the goal: proportional near it, beyond that what ``acceleration`` still stops.

    Both meet in value and slope where the proportional law itself asks for that deceleration.
    """
    linear = acceleration / (gain * gain)
    size = abs(distance)
    if size <= linear:
        return gain * distance
    return np.copysign(np.sqrt(2.0 * acceleration * (size - 0.5 * linear)), distance)


@njit(cache=True)
def _guide(m, target, gain, memory, dt):
    """Acceleration in n that is wanted, heading, and rate of heading."""
    to_north, to_east = target[NORTH] - memory[PLACE_NORTH], target[EAST] - memory[PLACE_EAST]
    limit, speed = gain[ACCELERATION], target[SPEED]
    heading, turn = target[HEADING], 0.0
    centripetal_north, centripetal_east = 0.0, 0.0
    if target[MODE] == TO_POINT:
        c, s = np.cos(target[COURSE]), np.sin(target[COURSE])
        along = clip(approach(c * to_north + s * to_east, gain[POSITION], limit), -speed, speed)
        across = clip(approach(c * to_east - s * to_north, gain[POSITION], limit), -speed, speed)
        north, east = c * along - s * across, s * along + c * across
    else:
        distance = max(np.hypot(to_north, to_east), 1e-3)
        inward_north, inward_east = to_north / distance, to_east / distance
        # to the right of the outward direction is the way round to the right
        way_north, way_east = target[SIDE] * inward_east, -target[SIDE] * inward_north
        inward = clip(gain[POSITION] * (distance - target[RADIUS]), -speed, speed)
        north, east = speed * way_north + inward * inward_north, speed * way_east + inward * inward_east
        flown = m[V_NORTH] * way_north + m[V_EAST] * way_east
        turn = target[SIDE] * flown / target[RADIUS]
        centripetal = min(flown * flown / target[RADIUS], limit)
        centripetal_north, centripetal_east = centripetal * inward_north, centripetal * inward_east
        heading = np.arctan2(way_east, way_north)
    size = np.hypot(north, east)
    share = speed / size if size > speed else 1.0
    climb = approach(target[ALTITUDE] - m[HEIGHT], gain[POSITION], limit)
    down = clip(-climb, -target[CLIMB], target[DESCENT])
    held = target[STATE] != FLYING
    change_north, change_east, change_down = _ramp(
        memory, (share * north, share * east, down), limit * dt, target[MODE] == CIRCLE
    )
    a_north = _follow(m[V_NORTH], change_north / dt, gain, memory, 0, held)
    a_east = _follow(m[V_EAST], change_east / dt, gain, memory, 1, held)
    a_down = _follow(m[V_DOWN], change_down / dt, gain, memory, 2, held)
    return (a_north + centripetal_north, a_east + centripetal_east, a_down), heading, turn


@njit(cache=True)
def _ramp(memory, wanted, most, turning):
    """Move the velocity reference towards ``wanted`` by at most ``most``; how far it moved, which is fed forward.

    On a circle the reference turns with the place, and what feeds that forward is the centripetal acceleration.
    """
    north, east = wanted[0] - memory[WANTED], wanted[1] - memory[WANTED + 1]
    down = clip(wanted[2] - memory[WANTED + 2], -most, most)
    size = np.hypot(north, east)
    if size > most:
        north, east = north * most / size, east * most / size
    memory[WANTED] += north
    memory[WANTED + 1] += east
    memory[WANTED + 2] += down
    return (0.0, 0.0, down) if turning else (north, east, down)


@njit(cache=True)
def _follow(v, forward, gain, memory, axis, held):
    """Acceleration of one axis that makes the velocity its reference; on the ground the integral is held."""
    error = memory[WANTED + axis] - v
    if not held:
        wound = memory[INTEGRAL + axis] + gain[VELOCITY_INTEGRAL] * error * gain[PERIOD]
        memory[INTEGRAL + axis] = clip(wound, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
    return forward + gain[VELOCITY] * error + memory[INTEGRAL + axis]


@njit(cache=True)
def _tilt(m, gain, acceleration):
    """Thrust over weight, and roll and pitch, that give an acceleration in n."""
    c, s = np.cos(m[YAW]), np.sin(m[YAW])
    forward, right = c * acceleration[0] + s * acceleration[1], c * acceleration[1] - s * acceleration[0]
    up = clip(G0 - acceleration[2], 0.3 * G0, 2.0 * G0)
    most, size = up * np.tan(gain[TILT_LIMIT]), np.hypot(forward, right)
    if size > most:
        forward, right = forward * most / size, right * most / size
    pitch = -np.arctan2(forward, up)
    roll = np.arctan2(right * np.cos(pitch), up)
    return up / G0 / max(0.5, np.cos(m[ROLL]) * np.cos(m[PITCH])), (roll, pitch)


@njit(cache=True)
def _turn(m, gain, memory, tilt, yawing, flying):
    """Commands about the three axes of b that bring roll, pitch and heading."""
    limit, dt = gain[RATE_LIMIT], gain[PERIOD]
    roll = clip(gain[ATTITUDE] * wrap(tilt[0] - m[ROLL]), -limit, limit)
    pitch = clip(gain[ATTITUDE] * wrap(tilt[1] - m[PITCH]), -limit, limit)
    most = gain[YAW_RATE_LIMIT]
    yaw = clip(gain[HEADING_GAIN] * wrap(yawing[0] - m[YAW]) + yawing[1], -most, most)
    sin_roll, cos_roll, cos_pitch = np.sin(m[ROLL]), np.cos(m[ROLL]), np.cos(m[PITCH])
    # Euler rates to body rates, Groves eq. 2.56
    p = roll - yaw * np.sin(m[PITCH]) - m[P]
    q = pitch * cos_roll + yaw * sin_roll * cos_pitch - m[Q]
    r = -pitch * sin_roll + yaw * cos_roll * cos_pitch - m[R]
    if flying:
        memory[RATE_INTEGRAL] = _wind_up(memory[RATE_INTEGRAL], gain[RATE_INTEGRAL_GAIN] * p * dt)
        memory[RATE_INTEGRAL + 1] = _wind_up(memory[RATE_INTEGRAL + 1], gain[RATE_INTEGRAL_GAIN] * q * dt)
        memory[RATE_INTEGRAL + 2] = _wind_up(memory[RATE_INTEGRAL + 2], gain[RATE_INTEGRAL_GAIN] * r * dt)
    return (
        gain[RATE] * p + memory[RATE_INTEGRAL],
        gain[RATE] * q + memory[RATE_INTEGRAL + 1],
        gain[YAW_RATE] * r + memory[RATE_INTEGRAL + 2],
    )


@njit(cache=True)
def _wind_up(integral, change):
    return clip(integral + change, -RATE_INTEGRAL_LIMIT, RATE_INTEGRAL_LIMIT)
