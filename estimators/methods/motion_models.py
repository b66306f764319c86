"""Motion models of the direct (total-state) filters: constant velocity, coordinated turn, accelerated, singer.

Equations: the IMM-RSTEKF paper (2023), with the NED mechanization of `strapdown` for the accelerated model; kernels only.
State x (15): position (m north, east, down of the reference `place`), velocity in n (m/s), roll, pitch, yaw (rad),
accelerometer bias (m/s²) and gyro bias (rad/s) in b. Order of `testbed.data.records.STATE_NAMES`, Euler angles for rotation.

``place`` (4,) is (lat, h, metres per radian of latitude, of longitude) of a fixed reference: position states are scaled
latitude, longitude and height, so nothing is lost far from the reference. All models share the attitude kinematics,
which leave out neither Earth nor transport rate. Euler angles have a pole at a pitch of ±90°: `body_axes` keeps away from it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core import strapdown
from testbed.kernels import njit
from testbed.kernels.lanes import alike
from testbed.physics import earth
from testbed.physics.rotations import euler_to_quat, quat_to_euler

Array = NDArray[np.float64]

N_STATES = 15
CV, CT, ACCELERATED, SINGER = 0, 1, 2, 3
MODELS = {"cv": CV, "ct": CT, "accelerated": ACCELERATED, "singer": SINGER}
"""Names in scenarios. `singer` carries an acceleration estimated from the last fixes on, fading with its time constant
(infinite: constant acceleration, CA)."""


COUPLED = np.zeros((len(MODELS), N_STATES, N_STATES), dtype=np.bool_)
"""Entries off the diagonal of `transition` that a model may fill."""
COUPLED[:, 0, 2:4] = COUPLED[:, 1, [0, 2, 4]] = COUPLED[:, 2, 5] = True
COUPLED[:, 6:9, [3, 4, 6, 7, 8, 12, 13, 14]] = True
COUPLED[CT, 3:5] = COUPLED[CT, 8]
COUPLED[ACCELERATED, 3:6, 2:12] = True
COUPLED[:, range(N_STATES), range(N_STATES)] = False


class Setting(NamedTuple):
    """What stays the same over a log, for every branch of a filter."""

    place: Array
    """(4,): see the head of this module."""
    centre: Array
    """(6,): where the accelerometer and gyro biases return to, m/s² and rad/s."""
    decay: Array
    """(2,): inverse correlation times of the biases, 1/s."""
    lever: Array
    """(3,): from the IMU to the antenna in b, m."""


class Motion(NamedTuple):
    """How one filter, or one branch of a bank, believes that the vehicle moves."""

    model: int
    """One of `MODELS`."""
    setting: Setting
    noise: Array
    """(13,): see `add_process_noise`."""
    held: Array
    """(3,): acceleration in n (m/s²), for `singer`."""


class Step(NamedTuple):
    """A stretch of an IMU interval."""

    imu: Array
    """(6,): means of angular rate (rad/s) and specific force (m/s²)."""
    corrections: Array
    """(6,): coning and sculling of this stretch, rad and m/s."""
    dt: float
    """s."""


@njit(cache=True, nogil=True, _nrt=False)
def advance(motion, x, step, out):
    """State ``out`` (15,) at the end of a `Step`, from ``x`` (15,); the two must not be one array."""
    model, (imu, corrections, dt), held = motion.model, step, motion.held
    place, centre, decay = motion.setting.place, motion.setting.centre, motion.setting.decay
    angle = ((imu[0] - x[12]) * dt, (imu[1] - x[13]) * dt, (imu[2] - x[14]) * dt)
    push = ((imu[3] - x[9]) * dt, (imu[4] - x[10]) * dt, (imu[5] - x[11]) * dt)
    coning = (corrections[0], corrections[1], corrections[2])
    sculling = (corrections[3], corrections[4], corrections[5])
    lat, h = place[0] + x[0] / place[2], place[1] - x[2]
    v = (x[3], x[4], x[5])
    q = euler_to_quat(x[6], x[7], x[8])
    rotation, change = strapdown.compensate(angle, push, coning, sculling)
    lat_end, lon_end, h_end, v_end, q_end, _ = strapdown.advance(lat, x[1] / place[3], h, v, q, rotation, change, dt)
    if model != ACCELERATED:
        v_end = _velocity_end(model, x, imu, dt, lat, h, held)
        rm, rn = earth.principal_radii(lat)
        lat_end = lat + 0.5 * dt * (v[0] + v_end[0]) / (rm + h)
        lon_end = x[1] / place[3] + 0.5 * dt * (v[1] + v_end[1]) / ((rn + h) * np.cos(lat))
        h_end = h - 0.5 * dt * (v[2] + v_end[2])
    out[0], out[1], out[2] = (lat_end - place[0]) * place[2], lon_end * place[3], place[1] - h_end
    out[3], out[4], out[5] = v_end
    out[6], out[7], out[8] = quat_to_euler(q_end)
    keep_accel, keep_gyro = np.exp(-dt * decay[0]), np.exp(-dt * decay[1])
    for i in range(3):
        out[9 + i] = centre[i] + keep_accel * (x[9 + i] - centre[i])
        out[12 + i] = centre[3 + i] + keep_gyro * (x[12 + i] - centre[3 + i])


@njit(cache=True, nogil=True, _nrt=False)
def _velocity_end(model, x, imu, dt, lat, h, held):
    """Velocity after ``dt`` under the models that do not use the accelerometers."""
    vn, ve, vd = x[3], x[4], x[5]
    if model == CT:
        turn = dt * yaw_rate(x, imu, lat, h)
        return (vn - turn * ve - 0.5 * turn * turn * vn, ve + turn * vn - 0.5 * turn * turn * ve, vd)
    if model == SINGER:
        return (vn + dt * held[0], ve + dt * held[1], vd + dt * held[2])
    return (vn, ve, vd)


@njit(cache=True, nogil=True, _nrt=False)
def yaw_rate(x, imu, lat, h):
    """Rate of the yaw angle (rad/s): the turn rate of the coordinated-turn model."""
    return euler_rates(x, imu, lat, h)[2]


@njit(cache=True, nogil=True, _nrt=False)
def euler_rates(x, imu, lat, h):
    """Time derivatives of roll, pitch and yaw (rad/s): gyro less bias, less Earth and transport rate."""
    sr, cr = np.sin(x[6]), np.cos(x[6])
    sp, cp = np.sin(x[7]), np.cos(x[7])
    sy, cy = np.sin(x[8]), np.cos(x[8])
    wx, wy, wz = imu[0] - x[12], imu[1] - x[13], imu[2] - x[14]
    across = wy * sr + wz * cr
    ie = earth.earth_rate_n(lat)
    en = earth.transport_rate_n(lat, h, x[3], x[4])
    north, east, down = ie[0] + en[0], en[1], ie[2] + en[2]
    along = cy * north + sy * east
    return (
        wx + across * sp / cp - along / cp,
        wy * cr - wz * sr + sy * north - cy * east,
        across / cp - along * sp / cp - down,
    )


@njit(cache=True, nogil=True, _nrt=False)
def transition(motion, x, step, phi):
    """Phi = I + F dt, the Jacobian of `advance`, into ``phi`` (15,15), which is zero below row 8 off its diagonal.

    Left out: derivatives of w_ie, w_en and the radii by latitude and height, below 1e-8 in F at 300 m/s.
    """
    for i in range(9):
        for j in range(N_STATES):
            phi[i, j] = 0.0
    model, (imu, _, dt) = motion.model, step
    place, decay = motion.setting.place, motion.setting.decay
    lat, h = place[0] + x[0] / place[2], place[1] - x[2]
    rm, rn = earth.principal_radii(lat)
    tl, cl = np.tan(lat), np.cos(lat)
    north, east = 1.0 / (rm + h), 1.0 / (rn + h)
    curved = (lat, h, tl, north, east)
    vn, ve = x[3], x[4]

    phi[0, 3] = dt * place[2] * north
    phi[0, 2] = dt * place[2] * north * north * vn
    phi[1, 4] = dt * place[3] * east / cl
    phi[1, 2] = phi[1, 4] * east * ve
    phi[1, 0] = phi[1, 4] * tl * ve / place[2]
    phi[2, 5] = dt
    _attitude_rows(x, imu, dt, curved, phi)
    if model == ACCELERATED:
        _accelerated_rows(x, imu, dt, curved, phi)
    elif model == CT:
        turn = yaw_rate(x, imu, lat, h)
        by_turn_n = -ve - dt * vn * turn
        by_turn_e = vn - dt * ve * turn
        for j in range(3, N_STATES):
            phi[3, j] = by_turn_n * phi[8, j]
            phi[4, j] = by_turn_e * phi[8, j]
        shrink = -0.5 * dt * dt * turn * turn
        phi[3, 3] += shrink
        phi[3, 4] -= dt * turn
        phi[4, 3] += dt * turn
        phi[4, 4] += shrink
    for i in range(9):
        phi[i, i] += 1.0
    for i in range(3):
        phi[9 + i, 9 + i] = np.exp(-dt * decay[0])
        phi[12 + i, 12 + i] = np.exp(-dt * decay[1])


@njit(cache=True, nogil=True, _nrt=False)
def _attitude_rows(x, imu, dt, curved, phi):
    """Rows 6 to 8 of F dt: Euler kinematics by attitude, velocity (transport rate) and gyro bias.

    ``curved``: latitude, height, tangent of latitude, and curvatures north and east (1/m).
    """
    lat, _, tl, north, east = curved
    sr, cr = np.sin(x[6]), np.cos(x[6])
    sp, cp = np.sin(x[7]), np.cos(x[7])
    sy, cy = np.sin(x[8]), np.cos(x[8])
    tp, sec = sp / cp, 1.0 / cp
    wy, wz = imu[1] - x[13], imu[2] - x[14]
    across, up = wy * sr + wz * cr, wy * cr - wz * sr
    in_n = earth.RATE * np.cos(lat) + x[4] * east
    in_e = -x[3] * north
    along, aside = cy * in_n + sy * in_e, cy * in_e - sy * in_n

    phi[6, 6] = dt * up * tp
    phi[6, 7] = dt * (across - along * sp) * sec * sec
    phi[6, 8] = -dt * aside * sec
    phi[7, 6] = -dt * across
    phi[7, 8] = dt * along
    phi[8, 6] = dt * up * sec
    phi[8, 7] = dt * (across * sp - along) * sec * sec
    phi[8, 8] = -dt * tp * aside

    phi[6, 3], phi[6, 4] = dt * sy * sec * north, -dt * cy * sec * east
    phi[7, 3], phi[7, 4] = dt * cy * north, dt * sy * east
    phi[8, 3], phi[8, 4] = dt * tp * sy * north, dt * (tl - tp * cy) * east

    phi[6, 12], phi[6, 13], phi[6, 14] = -dt, -dt * sr * tp, -dt * cr * tp
    phi[7, 13], phi[7, 14] = -dt * cr, dt * sr
    phi[8, 13], phi[8, 14] = -dt * sr * sec, -dt * cr * sec


@njit(cache=True, nogil=True, _nrt=False)
def _accelerated_rows(x, imu, dt, curved, phi):
    """Rows 3 to 5 of F dt of the strapdown velocity equation; ``curved`` as in `_attitude_rows`."""
    lat, h, tl, north, east = curved
    sr, cr = np.sin(x[6]), np.cos(x[6])
    sp, cp = np.sin(x[7]), np.cos(x[7])
    sy, cy = np.sin(x[8]), np.cos(x[8])
    c00, c01, c02 = cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy
    c10, c11, c12 = cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy
    c20, c21, c22 = -sp, sr * cp, cr * cp
    fx, fy, fz = imu[3] - x[9], imu[4] - x[10], imu[5] - x[11]
    fn = c00 * fx + c01 * fy + c02 * fz
    fe = c10 * fx + c11 * fy + c12 * fz
    fd = c20 * fx + c21 * fy + c22 * fz
    vn, ve, vd = x[3], x[4], x[5]

    # A change of an Euler angle turns f_n about that angle's axis.
    phi[3, 6], phi[4, 6], phi[5, 6] = dt * (c10 * fd - c20 * fe), dt * (c20 * fn - c00 * fd), dt * (c00 * fe - c10 * fn)
    phi[3, 7], phi[4, 7], phi[5, 7] = dt * cy * fd, dt * sy * fd, -dt * (sy * fe + cy * fn)
    phi[3, 8], phi[4, 8] = -dt * fe, dt * fn
    phi[3, 9], phi[3, 10], phi[3, 11] = -dt * c00, -dt * c01, -dt * c02
    phi[4, 9], phi[4, 10], phi[4, 11] = -dt * c10, -dt * c11, -dt * c12
    phi[5, 9], phi[5, 10], phi[5, 11] = -dt * c20, -dt * c21, -dt * c22

    ie_n, ie_d = earth.RATE * np.cos(lat), -earth.RATE * np.sin(lat)
    turn_d = 2.0 * ie_d - ve * tl * east
    phi[3, 3] = dt * vd * north
    phi[3, 4] = dt * (turn_d - ve * tl * east)
    phi[3, 5] = dt * vn * north
    phi[4, 3] = -dt * turn_d
    phi[4, 4] = dt * (vd + vn * tl) * east
    phi[4, 5] = dt * (2.0 * ie_n + ve * east)
    phi[5, 3] = -2.0 * dt * vn * north
    phi[5, 4] = -dt * (2.0 * ie_n + 2.0 * ve * east)
    phi[5, 2] = 2.0 * dt * earth.gravity(lat, h) / earth.A


@njit(cache=True, nogil=True, _nrt=False)
def add_process_noise(p, phi, noise, dt):
    """Add the process noise of ``dt`` to P, after ``phi`` = `transition` of that stretch.

    ``noise`` (13,): spectral densities of accelerometer and gyro white noise, of the noises that drive their biases (3
    each, along b), and of an acceleration in n that the model leaves out ((m/s²)²/Hz). White sensor noise enters the
    state exactly as a bias does, so its input matrix is the bias columns of ``phi``.
    """
    for i in range(3, 9):
        for j in range(3, i + 1):
            total = alike(phi[i, 9], 0.0)
            for k in range(6):
                total += phi[i, 9 + k] * phi[j, 9 + k] * noise[k]
            total /= dt
            p[i, j] += total
            if i != j:
                p[j, i] += total
    for i in range(3):
        p[3 + i, 3 + i] += noise[12] * dt
    for i in range(6):
        p[9 + i, 9 + i] += noise[6 + i] * dt
