"""Every block and every aiding against numerical derivatives, through the filter's own retraction and prediction.

Errors are "truth minus estimate", as corrections are. Each part is called as the loop calls it, for floats and for lanes.
"""

from functools import cache

import numpy as np
import pytest
from analytic_flight import analytic_flight
from filter_steps import begin, catch_up, predict, retract
from numba import njit

from estimators.core import calls
from estimators.core.composition import Composition, make_model, make_recording, prepare
from estimators.core.model import AUX, INVARIANT
from estimators.core.parts import AIDINGS, BLOCKS
from estimators.core.propagate import NAV
from testbed.base.schema import validate
from testbed.kernels.lanes import WIDTH
from testbed.kernels.tables import side_by_side, spread, zeros
from testbed.physics import earth
from testbed.physics.rotations import attitude_error, quat_multiply, quat_to_rotvec, rotvec_to_quat
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

ARM = [1.2, -0.4, 0.7]
STEPS = np.repeat([1.0, 1e-2, 1e-4], 3)
"""Position m, velocity m/s, attitude rad: rounding of a position on the Earth, 1e-9 m, then stays below 1e-9 per m, and the
third derivatives of rotated vectors below 1e-8 / 6 of their length."""
AUX_STEP = 1e-4
SENSORS = {
    "imu": {"model": "ADIS16448"},
    "gnss": {
        "model": "module-class",
        "mode": "satellites",
        "lever_arm_m": ARM,
        "satellites": {"systems": ["gps", "galileo"]},
    },
    "mag": {"model": "ADIS16448"},
    "baro": {"model": "ADIS16448"},
    "odometer": {"model": "car", "lever_arm_m": ARM},
}


@cache
def prepared():
    """A log of hard manoeuvres with every sensor, and a composition of every part."""
    flight = analytic_flight(6.0, 100.0)
    log, _ = sense_flight(validate(SensorsConfig, SENSORS, "sensors"), InitialConfig(), flight, 3)
    return prepare(Composition(tuple(BLOCKS), tuple(AIDINGS)), log)


@cache
def made():
    """The model half a second into the log, all sensor errors away from zero; its state is put back by who changes it."""
    model = make_model(prepared(), make_recording(prepared()))
    rng = np.random.default_rng(1)
    model.state[:] = prepared().start
    model.state[AUX:] += 0.01 * rng.standard_normal(len(model.state) - AUX)
    for values in (model.inputs.white, model.inputs.drive):
        values[:] = 0.0
    return model


def moved(x):
    """The state with the correction ``x`` (n,) added to it."""
    model = made()
    before, model.work.x[:] = model.state.copy(), x
    retract(model)
    after, model.state[:] = model.state.copy(), before
    return after


def difference(a, b):
    """Correction (n,) that leads from state ``b`` to ``a``, for small ones."""
    north, east = earth.metres_per_radian(b[0], b[2])
    place = [(a[0] - b[0]) * north, (a[1] - b[1]) * east, b[2] - a[2]]
    return np.concatenate([place, a[3:6] - b[3:6], attitude_error(a[6:10], b[6:10]), a[AUX:] - b[AUX:]])


@njit
def call_part(where, state, imu, parameters, z, residual, h):
    calls.call_measure(where, (state, imu, parameters, z, residual, h))


@njit
def call_part_lanes(where, state, imu, parameters, z, residual, h):
    calls.call_measure_lanes(where, (state, imu, parameters, z, residual, h))


@njit
def call_couple_lanes(where, aux, imu, accel, gyro):
    calls.call_couple_lanes(where, (aux, imu, accel, gyro))


def columns():
    """First column of each block."""
    firsts = NAV + np.cumsum([0, *(len(block.states) for block in prepared().blocks)])
    return {block.name: int(first) for block, first in zip(prepared().blocks, firsts, strict=False)}


def sample(state):
    """An IMU sample of the log without the biases of a state: what the loop hands to ``measure``."""
    first = columns()
    imu = made().inputs.imu[50].copy()
    imu[:3] -= state[first["gyro-bias"] + 1 :][:3]
    imu[3:] -= state[first["accel-bias"] + 1 :][:3]
    return imu


def measured(aiding, state):
    """Residual (m,) and H (m,n) of the first sample; of a zero one where this flight has none (it never stands)."""
    k = list(AIDINGS).index(aiding)
    part, values = AIDINGS[aiding], prepared().measurements[k]
    z = values.z[0].copy() if len(values.z) else np.zeros(values.z.shape[1])
    m = len(part.channels)
    residual, h = np.zeros(m), np.zeros((m, len(prepared().states)))
    call_part(calls.address(part.measure, calls.MEASURE), state, sample(state), values.parameters, z, residual, h)
    return residual, h


@pytest.mark.parametrize("aiding", AIDINGS)
def test_aiding(aiding):
    """H = -d residual / d x: to 1e-5 of its largest element (third derivatives, curvature of the Earth over a metre, and
    what gravity loses on it), and to what the Earth turns of a lever arm."""
    state = made().state
    _, h = measured(aiding, state)
    numerical = np.empty_like(h)
    for i in range(h.shape[1]):
        x = np.zeros(h.shape[1])
        x[i] = STEPS[i] if i < NAV else AUX_STEP
        plus, minus = (measured(aiding, moved(sign * x))[0] for sign in (1.0, -1.0))
        numerical[:, i] = -(plus - minus) / (2.0 * x[i])
    slack = 1e-5 * np.abs(h).max() + earth.RATE * np.linalg.norm(ARM)
    np.testing.assert_allclose(h, numerical, rtol=0.0, atol=slack)
    assert np.abs(h).max() > 0.5 or aiding == "heading"


@pytest.mark.parametrize("aiding", [name for name in AIDINGS if AIDINGS[name].in_lanes])
def test_aiding_in_lanes(aiding):
    """Each lane is the float version: to rounding (sines are series there) of the largest number that goes into it, which
    for a position is the radius of the Earth, for a range rate a satellite's speed, and a speed or a field of 100 elsewhere."""
    k = list(AIDINGS).index(aiding)
    part, values, n = AIDINGS[aiding], prepared().measurements[k], len(prepared().states)
    m, rng = len(part.channels), np.random.default_rng(2)
    steps = np.concatenate([100.0 * STEPS, np.full(n - NAV, AUX_STEP)])
    states = [moved(steps * rng.standard_normal(n)) for _ in range(WIDTH)]
    state, imu, residual, h = side_by_side(states), side_by_side([sample(one) for one in states]), zeros(m), zeros(m, n)
    z = values.z[0].copy() if len(values.z) else np.zeros(values.z.shape[1])
    where = calls.address(part.measure, calls.MEASURE_LANES)
    call_part_lanes(where, state, imu, values.parameters, spread(z), residual, h)
    for lane, one in enumerate(states):
        expected, expected_h = measured(aiding, one)
        for a, channel in enumerate(part.channels):
            size = earth.A if channel.endswith(", m") else 4000.0 if aiding == "doppler" else 100.0
            assert residual.array[a, lane] == pytest.approx(expected[a], abs=4.0 * np.finfo(float).eps * size)
        np.testing.assert_allclose(
            h.array[:, :, lane], expected_h, rtol=0.0, atol=1e-13 * max(1.0, np.abs(expected_h).max())
        )


def imu_model(block, aux, imu):
    """Specific force and angular rate as Groves, eq. 4.16 and 4.17, make them of true ones: written from the book."""
    rate, force = imu[:3].copy(), imu[3:].copy()
    off = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    triad = block.partition("-")[0]
    source = force if triad == "accel" else rate
    if block.endswith("bias") and triad in ("accel", "gyro"):
        source += aux
    elif block.endswith("scale") and triad in ("accel", "gyro"):
        source *= 1.0 + aux
    elif block.endswith("misalignment"):
        source += [
            sum(aux[k] * x for k, (i, j) in enumerate(off) if i == axis for x in [imu[j + 3 * (triad == "accel")]])
            for axis in range(3)
        ]
    elif block == "g-sensitivity":
        rate += aux.reshape(3, 3) @ force
    return np.concatenate([force, rate])


@pytest.mark.parametrize("block", BLOCKS)
def test_block(block):
    """``couple`` is the derivative of the sensor's equation, which is linear: exact to rounding; lanes hold the same bits."""
    part, imu = BLOCKS[block], np.array([0.4, -0.7, 0.2, 3.0, -5.0, -11.0])
    k = len(part.states)
    if part.couple is None:
        assert part.adds_to == ""
        return
    accel, gyro = np.zeros((k, 3)), np.zeros((k, 3))
    calls.couple_now(calls.address(part.couple, calls.COUPLE), np.zeros(k), imu, accel, gyro)
    for i in range(k):
        unit = np.eye(k)[i]
        numerical = 0.5 * (imu_model(block, unit, imu) - imu_model(block, -unit, imu))
        np.testing.assert_allclose(np.concatenate([accel[i], gyro[i]]), numerical, rtol=0.0, atol=1e-14 * 11.0)
    many, turn = zeros(k, 3), zeros(k, 3)
    call_couple_lanes(calls.address(part.couple, calls.COUPLE_LANES), zeros(k), spread(imu), many, turn)
    for lane in range(WIDTH):
        np.testing.assert_array_equal(many.array[..., lane], accel)
        np.testing.assert_array_equal(turn.array[..., lane], gyro)


@pytest.mark.parametrize("block", BLOCKS)
def test_block_in_the_loop(block):
    """What a step makes of a unit of each state: columns of the transition, which the covariance reveals, against the
    strapdown's own differences. The two differ by terms of second order in the angle that is turned in the step, 1 rad/s for
    10 ms."""
    model, first = made(), columns()[block]
    start, k = model.state.copy(), 50
    n, dt = len(prepared().states), 0.01

    def step(x):
        model.state[:] = moved(x)
        model.work.whole[:], model.work.clean[:] = 0.0, model.inputs.imu[k - 1]  # nothing taken off before
        begin(model, k, dt)
        predict(model, k, dt, 1.0)
        catch_up(model)
        end, model.state[:] = model.state.copy(), start
        return end

    own = next(made for made in prepared().blocks if made.name == block)
    for i in range(first, first + len(own.states)):
        unit = np.eye(n)[i]
        model.p[:, :n] = np.outer(unit, unit)
        step(np.zeros(n))
        root = np.sqrt(model.p[i, i])
        analytic = model.p[:n, i] / root
        numerical = difference(step(AUX_STEP * unit), step(-AUX_STEP * unit)) / (2.0 * AUX_STEP)
        turned = 1e-4 * np.abs(analytic[3:9]).max() + 1e-9
        # A rate error turns the force of half the step, f dt / 2; what is neglected there is the angle itself, up to 2 %.
        lever = 0.02 * np.abs(analytic[6:9]).max() * 0.5 * np.linalg.norm(made().inputs.imu[k, 3:]) * dt
        # A position carries the rounding of the Earth's radius, 1e-9 m / 2e-4.
        # and a receiver's clock that of a state of 1e5 m.
        rounding = 1e-9 + 4.0 * np.finfo(float).eps * np.abs(start[AUX:]) / AUX_STEP
        slack = np.concatenate([np.full(3, 2e-5), np.full(3, turned + lever), np.full(3, turned), rounding])
        assert (np.abs(analytic - numerical) <= slack).all(), (i, analytic - numerical)


def test_what_a_large_correction_leaves_of_an_attitude_error():
    """P after a correction x of 6 degrees, for an error x + p along any p: log(exp(x + p) exp(-x)), by quaternions. The series
    goes on with x² p / 6, below 2e-3 p; without the first term P would miss by x p / 2, 5e-2 p."""
    model, n, x = made()._replace(error=INVARIANT), len(prepared().states), np.array([0.06, -0.07, 0.05])
    for axis in range(3):
        p, rest = 1e-6 * np.eye(3)[axis], np.zeros(n)
        rest[6:9] = p
        both, back = np.array(rotvec_to_quat(x + p)), np.array(rotvec_to_quat(-x))
        expected = quat_to_rotvec(np.array(quat_multiply(both, back)))
        model.p[:, :n] = np.outer(rest, rest)
        before = model.state.copy()
        model.work.x[:] = 0.0
        model.work.x[6:9] = x
        retract(model)
        model.state[:] = before
        np.testing.assert_allclose(model.p[6:9, 6:9], np.outer(expected, expected), rtol=0.0, atol=2.0 * 2e-3 * 1e-12)
