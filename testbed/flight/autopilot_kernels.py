"""The autopilot: successive loops from bank, path and speed targets to aileron, elevator, rudder and throttle.

Structure after Stevens and Lewis, *Aircraft Control and Simulation*, chapter 4, and Beard and McLain, chapter 6: rate
loops inside, coordinated-turn kinematics as feed-forward, load factor and incidence as limits. On the ground and close above
it a pitch angle is held, the throttle is set, and nose wheel and rudder keep the heading. SI units and radians.

`step` is one tick. Its arrays are indexed by the names below; nothing is allocated. They are views of one array, the
desk, because handing arrays to a compiled function costs more than the arithmetic.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.physics.earth import G0
from testbed.physics.rotations import wrap

# measurements
ROLL, PITCH, YAW, P, Q, R, AIRSPEED, ALPHA, BETA, HEIGHT, CLIMB_RATE = range(11)
MEASUREMENTS = 11

# targets
LATERAL_MODE, BANK, HEADING, VERTICAL_MODE, ALTITUDE, CLIMB, SPEED, BANK_LIMIT, ACCELERATION = range(9)
AILERON_OFFSET, ELEVATOR_OFFSET, RUDDER_OFFSET, PITCH_ANGLE, THROTTLE_MODE, THROTTLE_SET, STEERING = range(9, 16)
TARGETS = 16
HOLD_BANK, HOLD_HEADING = 0.0, 1.0
HOLD_ALTITUDE, HOLD_CLIMB, HOLD_PITCH, HANDS_OFF = 0.0, 1.0, 2.0, 3.0
HOLD_SPEED, BY_HAND = 0.0, 1.0
"""Of the throttle. `STEERING` is 0 in the air, 1 where the wheels steer."""

# memory
ROLL_INTEGRAL, PITCH_INTEGRAL, THROTTLE_INTEGRAL, CLIMB_INTEGRAL, SPEED_REFERENCE, CLIMB_REFERENCE = range(6)
MEMORY = 6

# commands
AILERON, ELEVATOR, RUDDER, THROTTLE, STEER = range(5)
COMMANDS = 5
DESK = MEASUREMENTS + TARGETS + MEMORY + COMMANDS

# gains and limits of the aircraft
(
    SPEED_NOMINAL,
    ROLL_ANGLE,
    ROLL_RATE,
    ROLL_RATE_INTEGRAL,
    ROLL_RATE_FEEDFORWARD,
    ROLL_RATE_LIMIT,
    PITCH_RATE,
    PITCH_RATE_INTEGRAL,
    LOAD_FEEDFORWARD,
    SIDESLIP,
    YAW_RATE,
    YAW_FEEDFORWARD,
    HEADING_GAIN,
    ALTITUDE_GAIN,
    CLIMB_GAIN,
    CLIMB_INTEGRAL_GAIN,
    CLIMB_LIMIT,
    CLIMB_ACCELERATION,
    SPEED_GAIN,
    SPEED_INTEGRAL,
    THRUST_TO_WEIGHT,
    THROTTLE_TRIM,
    LOAD_FACTOR_MAX,
    LOAD_FACTOR_MIN,
    ALPHA_MAX,
    PERIOD,
    PITCH_ANGLE_GAIN,
    PITCH_RATE_LIMIT,
    STEER_HEADING,
    STEER_RATE,
    STEER_FULL,
) = range(31)
GAINS = 31


@njit(cache=True)
def clip(value, low, high):
    """Value held between two limits."""
    return min(high, max(low, value))


@njit(cache=True)
def desk_views(desk, measurements, targets, memory):
    """Measurements, targets, memory and commands: views of the desk, in this order, of these lengths; commands are the rest."""
    a, b = measurements + targets, measurements + targets + memory
    return desk[:measurements], desk[measurements:a], desk[a:b], desk[b:]


@njit(cache=True)
def step(desk, gain):
    """One tick of ``gain[PERIOD]`` seconds: fills the commands from the targets and advances the memory."""
    measured, target, memory, command = desk_views(desk, MEASUREMENTS, TARGETS, MEMORY)
    dt = gain[PERIOD]
    v = max(measured[AIRSPEED], 1.0)
    # the moment of a surface grows with the dynamic pressure, and damping too: gain falls with the square of speed
    schedule = clip((gain[SPEED_NOMINAL] / v) ** 2, 0.3, 3.0)
    command[AILERON] = _roll(measured, target, gain, memory, schedule, v, dt)
    command[ELEVATOR] = _pitch(measured, target, gain, memory, schedule, v, dt)
    command[RUDDER] = _yaw(measured, target, gain, schedule, v)
    command[THROTTLE] = _throttle(measured, target, gain, memory, v, dt)
    command[STEER] = 0.0
    if target[STEERING] != 0.0:
        memory[ROLL_INTEGRAL] = 0.0
        turn = gain[STEER_HEADING] * wrap(target[HEADING] - measured[YAW]) - gain[STEER_RATE] * measured[R]
        command[RUDDER] = -clip(turn, -1.0, 1.0)
        # the same angle of the nose wheel turns faster, and the rudder bites
        command[STEER] = clip(turn * min(1.0, gain[STEER_FULL] / v), -1.0, 1.0)


@njit(cache=True)
def _roll(m, target, gain, memory, schedule, v, dt):
    bank = target[BANK]
    if target[LATERAL_MODE] == HOLD_HEADING:
        rate = gain[HEADING_GAIN] * wrap(target[HEADING] - m[YAW])
        bank = clip(np.arctan(rate * v / G0), -target[BANK_LIMIT], target[BANK_LIMIT])
    limit = gain[ROLL_RATE_LIMIT]
    rate_command = clip(gain[ROLL_ANGLE] * (bank - m[ROLL]), -limit, limit)
    error = rate_command - m[P]
    # roll damping grows with speed, aileron power with its square
    feedforward = gain[ROLL_RATE_FEEDFORWARD] * rate_command * gain[SPEED_NOMINAL] / v
    aileron = feedforward + schedule * (gain[ROLL_RATE] * error + memory[ROLL_INTEGRAL]) + target[AILERON_OFFSET]
    if abs(aileron) < 1.0 or aileron * error < 0.0:
        memory[ROLL_INTEGRAL] = clip(memory[ROLL_INTEGRAL] + gain[ROLL_RATE_INTEGRAL] * error * dt, -0.5, 0.5)
    return clip(aileron, -1.0, 1.0)


@njit(cache=True)
def _pitch(m, target, gain, memory, schedule, v, dt):
    if target[VERTICAL_MODE] >= HOLD_PITCH:
        return _pitch_angle(m, target, gain, memory, schedule, dt)
    wanted = target[CLIMB]
    if target[VERTICAL_MODE] == HOLD_ALTITUDE:
        wanted = clip(gain[ALTITUDE_GAIN] * (target[ALTITUDE] - m[HEIGHT]), -gain[CLIMB_LIMIT], gain[CLIMB_LIMIT])
    # speed goes before height: from 8 % below the reference on, the climb is traded in, at 28 % it is a dive
    slow = 0.92 - v / max(memory[SPEED_REFERENCE], 1.0)
    if slow > 0.0:
        wanted = min(wanted, gain[CLIMB_LIMIT] * (1.0 - 10.0 * slow))
    ramp = gain[CLIMB_ACCELERATION] * dt
    memory[CLIMB_REFERENCE] += clip(wanted - memory[CLIMB_REFERENCE], -ramp, ramp)
    climb_error = memory[CLIMB_REFERENCE] - m[CLIMB_RATE]
    upward = gain[CLIMB_GAIN] * climb_error + memory[CLIMB_INTEGRAL]
    up_share = np.cos(m[PITCH]) * np.cos(m[ROLL])
    load = (1.0 + upward / G0) / max(up_share, 0.12)
    load_clipped = clip(load, gain[LOAD_FACTOR_MIN], gain[LOAD_FACTOR_MAX])
    if load == load_clipped:
        step = gain[CLIMB_INTEGRAL_GAIN] * clip(climb_error, -2.0, 2.0) * dt
        memory[CLIMB_INTEGRAL] = clip(memory[CLIMB_INTEGRAL] + step, -4.0, 4.0)
    rate_command = G0 / v * (load_clipped - up_share)
    rate_command = min(rate_command, 3.0 * (gain[ALPHA_MAX] - m[ALPHA]))
    steady = gain[LOAD_FEEDFORWARD] * (load_clipped - 1.0)
    return _elevator(rate_command - m[Q], steady, target, gain, memory, schedule, dt)


@njit(cache=True)
def _pitch_angle(m, target, gain, memory, schedule, dt):
    # what the climb's loops remember follows, so that they take over where this one leaves
    memory[CLIMB_REFERENCE], memory[CLIMB_INTEGRAL] = m[CLIMB_RATE], 0.0
    if target[VERTICAL_MODE] == HANDS_OFF:
        memory[PITCH_INTEGRAL] = 0.0
        return -clip(target[ELEVATOR_OFFSET], -1.0, 1.0)
    limit = gain[PITCH_RATE_LIMIT]
    rate_command = clip(gain[PITCH_ANGLE_GAIN] * (target[PITCH_ANGLE] - m[PITCH]), -limit, limit)
    return _elevator(rate_command - m[Q], 0.0, target, gain, memory, schedule, dt)


@njit(cache=True)
def _elevator(error, steady, target, gain, memory, schedule, dt):
    pull = schedule * (steady + gain[PITCH_RATE] * error + memory[PITCH_INTEGRAL]) + target[ELEVATOR_OFFSET]
    if abs(pull) < 1.0 or pull * error < 0.0:
        memory[PITCH_INTEGRAL] = clip(memory[PITCH_INTEGRAL] + gain[PITCH_RATE_INTEGRAL] * error * dt, -1.5, 1.5)
    return -clip(pull, -1.0, 1.0)


@njit(cache=True)
def _yaw(m, target, gain, schedule, v):
    coordinated = G0 / v * np.sin(m[ROLL]) * np.cos(m[PITCH])
    yaw_right = gain[SIDESLIP] * m[BETA] + gain[YAW_RATE] * (coordinated - m[R])
    # a yaw damper inside the aircraft's own flight control opposes the turn: what that adds is taken off, beyond the
    # range of the pedals if need be, because it is the damper's output that is limited
    against = gain[YAW_FEEDFORWARD] * coordinated
    return -clip(schedule * yaw_right + target[RUDDER_OFFSET], -1.0, 1.0) - against


@njit(cache=True)
def _throttle(m, target, gain, memory, v, dt):
    if target[THROTTLE_MODE] == BY_HAND:
        memory[SPEED_REFERENCE] = v
        memory[THROTTLE_INTEGRAL] = clip(target[THROTTLE_SET] - gain[THROTTLE_TRIM], -1.0, 1.0)
        return target[THROTTLE_SET]
    ramp = target[ACCELERATION] * dt
    change = clip(target[SPEED] - memory[SPEED_REFERENCE], -ramp, ramp)
    memory[SPEED_REFERENCE] += change
    error = memory[SPEED_REFERENCE] - v
    # thrust minus drag over weight is what climbs and accelerates
    excess = memory[CLIMB_REFERENCE] / v + (gain[SPEED_GAIN] * error + change / dt) / G0
    throttle = gain[THROTTLE_TRIM] + memory[THROTTLE_INTEGRAL] + excess / gain[THRUST_TO_WEIGHT]
    if 0.0 < throttle < 1.0 or (throttle - 0.5) * error < 0.0:
        memory[THROTTLE_INTEGRAL] = clip(memory[THROTTLE_INTEGRAL] + gain[SPEED_INTEGRAL] * error * dt, -1.0, 1.0)
    return clip(throttle, 0.0, 1.0)
