"""`indirect_kernel.filter_log` and its scores for several candidates at once: one candidate per lane of a vector register.

Kernels only; equations, states and units as there, and as `error_model` and `strapdown`. The candidates share the recording
and differ in Q and R. The covariance uses its symmetry: Phi P for all columns, then the upper triangle of (Phi P) Phi'.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.core.lanes import WIDTH, circular, load, splat, store
from estimators.error_model import N_STATES, coefficients
from estimators.indirect_kernel import SAME_TIME, mean_matrix
from estimators.indirect_search_update import update_lanes, wrapped
from estimators.strapdown import compensate, coning_sculling, increments
from testbed import earth
from testbed.rotations import cross, matrix_rotate, quat_multiply, quat_to_euler, quat_to_matrix, wrap

NAV = 9
"""States before the biases."""
COEFFICIENTS = 43
STATE = 16
"""lat, lon, h, v_n, q_nb, accelerometer and gyro bias."""
# Rows of the table of coefficients, all times the step: attitude from attitude, velocity and position; then velocity.
IN_N, IN_E, IN_D, NUE, NRD, NRN, EUN, ERD, DUE, DRD, DRN = range(11)
BODY = 11
FORCE = 20
UN, UE, UD = 23, 28, 33
"""Velocity north, east, down from its own north, east, down, and from position down and north."""
POSITION = 38


@njit(cache=True, nogil=True)
def filter_lanes(
    t_start, t, gyro, accel, lever, fix_t, fix_lla, fix_v, variance, start, q, decay, bias_mean, stride, truth, p, rmse
):
    """Write ``rmse`` (9,WIDTH), m N, E, D; m/s; rad, and return the mean deviance (WIDTH,) of the innovations per fix.

    Arguments as `indirect_kernel.filter_log`, but for tables of lanes: ``variance`` (6 M,WIDTH), ``q`` (12,WIDTH), and
    ``p`` (225,WIDTH), P0 when called and P at the end. ``truth`` (K,11): lat, lon, h, v_n, Euler angles, and the metres
    per radian there. Not finite in the lanes that diverge.
    """
    w, c, s, scratch = _tables(NAV * N_STATES), _tables(COEFFICIENTS), _tables(STATE), _tables(128)
    deviance = np.zeros(WIDTH)
    lat, lon, h = splat(start[0]), splat(start[1]), splat(start[2])
    v = (splat(start[3]), splat(start[4]), splat(start[5]))
    qn = (splat(start[6]), splat(start[7]), splat(start[8]), splat(start[9]))
    ba = (splat(start[10]), splat(start[11]), splat(start[12]))
    bg = (splat(start[13]), splat(start[14]), splat(start[15]))
    m = quat_to_matrix(qn)
    zero = splat(0.0)
    angle_before = velocity_before = (zero, zero, zero)
    rmse[:] = 0.0
    now = t_start
    next_fix = used = 0
    while next_fix < fix_t.shape[0] and fix_t[next_fix] < t_start - SAME_TIME:
        next_fix += 1

    for k in range(t.shape[0]):
        whole = t[k] - now
        angle, dv = increments(gyro[k], accel[k], bg, ba, whole)
        coning, sculling = coning_sculling(angle, dv, angle_before, velocity_before)
        angle_before, velocity_before = angle, dv
        while True:
            has_fix = next_fix < fix_t.shape[0] and fix_t[next_fix] <= t[k] + SAME_TIME
            target = min(fix_t[next_fix], t[k]) if has_fix else t[k]
            dt = target - now
            if dt > SAME_TIME:
                angle, dv = increments(gyro[k], accel[k], bg, ba, dt)
                keep_accel, keep_gyro = np.exp(-dt * decay[0]), np.exp(-dt * decay[1])
                rotation, change = compensate(angle, dv, scaled(coning, dt / whole), scaled(sculling, dt / whole))
                error_rates = coefficients(lat, h, v)
                lat, lon, h, v_end, qn, force = advance(lat, lon, h, v, qn, m, rotation, change, dt)
                m_end = quat_to_matrix(qn)
                middle = mean_matrix(m, m_end)
                write_coefficients(c, error_rates, middle, force, v, dt)
                propagate_lanes(p, w, c, keep_accel, keep_gyro, 0.5 * dt)
                add_noise_lanes(p, c, q, dt)
                mirror(p)
                ba, bg = returned(ba, bias_mean[:3], keep_accel), returned(bg, bias_mean[3:], keep_gyro)
                v, m = v_end, m_end
                now = target
            if not has_fix:
                break
            write_state(s, lat, lon, h, v, qn, ba, bg)
            update_lanes(
                s, p, scratch, gyro[k], lever, fix_lla[next_fix], fix_v[next_fix], variance, next_fix, deviance
            )
            mirror(p)
            lat, lon, h, v, qn, ba, bg = read_state(s)
            m = quat_to_matrix(qn)
            next_fix += 1
            used += 1
        now = t[k]
        if (k + 1) % stride == 0:
            write_state(s, lat, lon, h, v, qn, ba, bg)
            add_squares(s, truth[k // stride], rmse)
    rmse[:] = np.sqrt(rmse / truth.shape[0])
    return deviance / used if used > 0 else np.full(WIDTH, np.inf)


@njit(cache=True, nogil=True)
def _tables(rows):
    """(rows,WIDTH) zeros on cache lines: a load that crosses a line costs two."""
    raw = np.zeros((rows + 1) * WIDTH)
    skip = (-raw.ctypes.data // 8) % WIDTH
    return raw[skip : skip + rows * WIDTH].reshape(rows, WIDTH)


@njit(cache=True, nogil=True, forceinline=True)
def scaled(a, factor):
    """A triple times a number."""
    return (a[0] * factor, a[1] * factor, a[2] * factor)


@njit(cache=True, nogil=True, forceinline=True)
def returned(bias, mean, keep):
    """Biases after a step towards their means."""
    return (
        mean[0] + keep * (bias[0] - mean[0]),
        mean[1] + keep * (bias[1] - mean[1]),
        mean[2] + keep * (bias[2] - mean[2]),
    )


@njit(cache=True, nogil=True)
def advance(lat, lon, h, v_n, q_nb, m, rotation, change_b, dt):
    """`strapdown.advance` with ``m`` = C_nb of the start, without its branch on the size of an angle."""
    change = matrix_rotate(m, change_b)
    half = 0.5 * dt
    rm, rn = earth.principal_radii(lat)
    mid_h = h - half * v_n[2]
    gravity = earth.gravity(lat, mid_h)
    mid_n = v_n[0] + 0.5 * change[0]
    mid_e = v_n[1] + 0.5 * change[1]
    mid_d = v_n[2] + 0.5 * (change[2] + gravity * dt)
    mid_lat = lat + half * v_n[0] / (rm + mid_h)
    sine, cosine = np.sin(mid_lat), np.cos(mid_lat)
    tangent = sine / cosine
    earth_n, earth_d = earth.RATE * cosine, -earth.RATE * sine
    rate_n = mid_e / (rn + mid_h)
    rate_e = -mid_n / (rm + mid_h)
    spin = (earth_n + rate_n, rate_e, earth_d - rate_n * tangent)
    frame = cross(spin, change)
    force = (change[0] - half * frame[0], change[1] - half * frame[1], change[2] - half * frame[2])
    coriolis = cross((spin[0] + earth_n, spin[1], spin[2] + earth_d), (mid_n, mid_e, mid_d))
    v_end = (
        v_n[0] + force[0] - coriolis[0] * dt,
        v_n[1] + force[1] - coriolis[1] * dt,
        v_n[2] + force[2] + (gravity - coriolis[2]) * dt,
    )
    lat_end = lat + half * (v_n[0] + v_end[0]) / (rm + mid_h)
    lon_end = lon + half * (v_n[1] + v_end[1]) / ((rn + mid_h) * cosine)
    h_end = h - half * (v_n[2] + v_end[2])
    q = quat_multiply(turn(scaled(spin, -dt)), quat_multiply(q_nb, turn(rotation)))
    scale = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    q_end = (q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale)
    return lat_end, lon_end, h_end, v_end, q_end, scaled(force, 1.0 / dt)


@njit(cache=True, nogil=True, forceinline=True)
def turn(v):
    """Quaternion of a rotation vector of at most a few radians."""
    sine, cosine = circular(-0.25 * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]))
    sine = 0.5 * sine
    return (cosine, sine * v[0], sine * v[1], sine * v[2])


@njit(cache=True, nogil=True)
def write_coefficients(c, rates, m, force, v_n, dt):
    """The table of coefficients: `error_model.apply_transition` sorted by what each state gives to each."""
    per_n, per_e, tangent, ie_n, ie_d, en_n, en_e, en_d, gradient = rates
    in_n, in_e, in_d = ie_n + en_n, en_e, ie_d + en_d
    co_n, co_e, co_d = in_n + ie_n, in_e, in_d + ie_d
    vn, ve, vd = v_n
    curve = en_n * (1.0 + tangent * tangent)
    store(c, IN_N, dt * in_n)
    store(c, IN_E, dt * in_e)
    store(c, IN_D, dt * in_d)
    store(c, NUE, dt * per_e)
    store(c, NRD, dt * en_n * per_e)
    store(c, NRN, dt * ie_d * per_n)
    store(c, EUN, dt * per_n)
    store(c, ERD, dt * en_e * per_n)
    store(c, DUE, dt * tangent * per_e)
    store(c, DRD, dt * tangent * en_n * per_e)
    store(c, DRN, dt * per_n * (curve + ie_n))
    for i in range(3):
        store_triple(c, BODY + 3 * i, 1, scaled(m[i], dt))
    store_triple(c, FORCE, 1, scaled(force, 0.5 * dt))
    store(c, UN, 1.0 + dt * per_n * vd)
    store(c, UN + 1, dt * (co_d - tangent * per_e * ve))
    store(c, UN + 2, -dt * co_e)
    store(c, UN + 3, -dt * (en_e * per_n * vd + tangent * en_n * per_e * ve))
    store(c, UN + 4, -dt * ve * per_n * (curve + 2.0 * ie_n))
    store(c, UE, -dt * co_d)
    store(c, UE + 1, 1.0 + dt * per_e * (tangent * vn + vd))
    store(c, UE + 2, dt * co_n)
    store(c, UE + 3, dt * en_n * per_e * (tangent * vn + vd))
    store(c, UE + 4, dt * per_n * ((curve + 2.0 * ie_n) * vn + 2.0 * ie_d * vd))
    store(c, UD, dt * (co_e - per_n * vn))
    store(c, UD + 1, -dt * (co_n + per_e * ve))
    store(c, UD + 2, splat(1.0))
    store(c, UD + 3, dt * (en_e * per_n * vn - en_n * per_e * ve + gradient))
    store(c, UD + 4, -2.0 * dt * ie_d * per_n * ve)
    store(c, POSITION, 1.0 - dt * per_n * vd)
    store(c, POSITION + 1, dt * per_n * vn)
    store(c, POSITION + 2, 1.0 - dt * per_e * (vd + vn * tangent))
    store(c, POSITION + 3, dt * per_e * ve)
    store(c, POSITION + 4, dt * per_e * ve * tangent)


@njit(cache=True, nogil=True, forceinline=True)
def attitude_part(c, r, u, a, g):
    """Attitude errors at the end of the step from position (north, down), velocity, attitude and gyro bias errors."""
    n = a[0] + load(c, IN_D) * a[1] - load(c, IN_E) * a[2]
    n = n - (load(c, NUE) * u[1] + load(c, NRD) * r[2] + load(c, NRN) * r[0])
    e = a[1] + load(c, IN_N) * a[2] - load(c, IN_D) * a[0]
    e = e + (load(c, EUN) * u[0] - load(c, ERD) * r[2])
    d = a[2] + load(c, IN_E) * a[0] - load(c, IN_N) * a[1]
    d = d + (load(c, DUE) * u[1] + load(c, DRD) * r[2] + load(c, DRN) * r[0])
    return n - body_row(c, 0, g), e - body_row(c, 1, g), d - body_row(c, 2, g)


@njit(cache=True, nogil=True, forceinline=True)
def body_row(c, i, b):
    """Row i of C_nb times the step, times ``b``."""
    return load(c, BODY + 3 * i) * b[0] + load(c, BODY + 3 * i + 1) * b[1] + load(c, BODY + 3 * i + 2) * b[2]


@njit(cache=True, nogil=True, forceinline=True)
def velocity_part(c, r, u, both, b):
    """Velocity errors at the end of the step; ``both``: attitude error at its start plus at its end; ``b`` accel bias."""
    fn, fe, fd = load(c, FORCE), load(c, FORCE + 1), load(c, FORCE + 2)
    n = velocity_row(c, UN, r, u) + (fd * both[1] - fe * both[2]) - body_row(c, 0, b)
    e = velocity_row(c, UE, r, u) + (fn * both[2] - fd * both[0]) - body_row(c, 1, b)
    d = velocity_row(c, UD, r, u) + (fe * both[0] - fn * both[1]) - body_row(c, 2, b)
    return n, e, d


@njit(cache=True, nogil=True, forceinline=True)
def velocity_row(c, row, r, u):
    own = load(c, row) * u[0] + load(c, row + 1) * u[1] + load(c, row + 2) * u[2]
    return own + (load(c, row + 3) * r[2] + load(c, row + 4) * r[0])


@njit(cache=True, nogil=True, forceinline=True)
def position_part(c, r, both, half):
    """Position errors at the end of the step; ``both``: velocity error at its start plus at its end."""
    n = load(c, POSITION) * r[0] + load(c, POSITION + 1) * r[2] + half * both[0]
    e = load(c, POSITION + 2) * r[1] + load(c, POSITION + 3) * r[2] + load(c, POSITION + 4) * r[0] + half * both[1]
    return n, e, r[2] + half * both[2]


@njit(cache=True, nogil=True, forceinline=True)
def triple(table, row, step):
    """Rows ``row``, ``row + step``, ``row + 2 step`` of a table."""
    return load(table, row), load(table, row + step), load(table, row + 2 * step)


@njit(cache=True, nogil=True, forceinline=True)
def plus(a, b):
    """Sum of triples."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True, nogil=True, forceinline=True)
def store_triple(table, row, step, a):
    """Set rows ``row``, ``row + step``, ``row + 2 step``."""
    store(table, row, a[0])
    store(table, row + step, a[1])
    store(table, row + 2 * step, a[2])


@njit(cache=True, nogil=True)
def propagate_lanes(p, w, c, keep_accel, keep_gyro, half):
    """P = Phi P Phi' on the upper triangle. Of P the blocks of the first nine and of the last six states must be whole."""
    for j in range(N_STATES):
        # By symmetry a row serves as column, where it is whole.
        first, step = (N_STATES * j, 1) if j < NAV else (j, N_STATES)
        r, u = triple(p, first, step), triple(p, first + 3 * step, step)
        a = triple(p, first + 6 * step, step)
        b, g = triple(p, N_STATES * j + 9, 1), triple(p, N_STATES * j + 12, 1)
        end = attitude_part(c, r, u, a, g)
        speed = velocity_part(c, r, u, plus(a, end), b)
        store_triple(w, j, N_STATES, position_part(c, r, plus(u, speed), half))
        store_triple(w, j + 3 * N_STATES, N_STATES, speed)
        store_triple(w, j + 6 * N_STATES, N_STATES, end)
    for i in range(NAV):
        row = N_STATES * i
        r, u, a = triple(w, row, 1), triple(w, row + 3, 1), triple(w, row + 6, 1)
        b, g = triple(w, row + 9, 1), triple(w, row + 12, 1)
        end = attitude_part(c, r, u, a, g)
        store_triple(p, row + 6, 1, end)
        if i < 6:
            speed = velocity_part(c, r, u, plus(a, end), b)
            store_triple(p, row + 3, 1, speed)
            if i < 3:
                store_triple(p, row, 1, position_part(c, r, plus(u, speed), half))
        store_triple(p, row + 9, 1, scaled(b, keep_accel))
        store_triple(p, row + 12, 1, scaled(g, keep_gyro))
    for i in range(9, N_STATES):
        keep = keep_accel if i < 12 else keep_gyro
        for j in range(i, N_STATES):
            other = keep_accel if j < 12 else keep_gyro
            store(p, N_STATES * i + j, load(p, N_STATES * i + j) * (keep * other))


@njit(cache=True, nogil=True)
def add_noise_lanes(p, c, q, dt):
    """`error_model.add_noise` on the upper triangle."""
    for i in range(3):
        for j in range(i, 3):
            accel = density(c, q, 0, i, j) * (1.0 / dt)
            add(p, N_STATES * i + j, accel * (dt * dt / 3.0))
            add(p, N_STATES * i + 3 + j, accel * (0.5 * dt))
            if i != j:
                add(p, N_STATES * j + 3 + i, accel * (0.5 * dt))
            add(p, N_STATES * (3 + i) + 3 + j, accel)
            add(p, N_STATES * (6 + i) + 6 + j, density(c, q, 3, i, j) * (1.0 / dt))
    for i in range(6):
        add(p, (N_STATES + 1) * (9 + i), load(q, 6 + i) * dt)


@njit(cache=True, nogil=True, forceinline=True)
def density(c, q, first, i, j):
    """Entry (i,j) of C diag(q) C' times the step squared."""
    total = load(c, BODY + 3 * i) * load(c, BODY + 3 * j) * load(q, first)
    total = total + load(c, BODY + 3 * i + 1) * load(c, BODY + 3 * j + 1) * load(q, first + 1)
    return total + load(c, BODY + 3 * i + 2) * load(c, BODY + 3 * j + 2) * load(q, first + 2)


@njit(cache=True, nogil=True, forceinline=True)
def add(table, row, value):
    """Add to a row."""
    store(table, row, load(table, row) + value)


@njit(cache=True, nogil=True)
def mirror(p):
    """Make the blocks of the first nine and of the last six states whole from their upper triangles."""
    for i in range(1, N_STATES):
        for j in range(0 if i < NAV else NAV, i):
            store(p, N_STATES * i + j, load(p, N_STATES * j + i))


@njit(cache=True, nogil=True)
def write_state(s, lat, lon, h, v, q, ba, bg):
    """The table of states from what the loop holds."""
    store_triple(s, 0, 1, (lat, lon, h))
    store_triple(s, 3, 1, v)
    store(s, 6, q[0])
    store_triple(s, 7, 1, (q[1], q[2], q[3]))
    store_triple(s, 10, 1, ba)
    store_triple(s, 13, 1, bg)


@njit(cache=True, nogil=True)
def read_state(s):
    """lat, lon, h, v_n, q_nb, accelerometer bias, gyro bias."""
    q = (load(s, 6), load(s, 7), load(s, 8), load(s, 9))
    return load(s, 0), load(s, 1), load(s, 2), triple(s, 3, 1), q, triple(s, 10, 1), triple(s, 13, 1)


@njit(cache=True, nogil=True)
def add_squares(s, row, total):
    """Add the squares of the errors of the states in ``s`` against a row of truth to ``total`` (9,WIDTH)."""
    north, east, down = (load(s, 0) - row[0]) * row[9], wrapped(load(s, 1) - row[1]) * row[10], row[2] - load(s, 2)
    add(total, 0, north * north)
    add(total, 1, east * east)
    add(total, 2, down * down)
    for i in range(3):
        error = load(s, 3 + i) - row[3 + i]
        add(total, 3 + i, error * error)
    for lane in range(WIDTH):
        euler = quat_to_euler((s[6, lane], s[7, lane], s[8, lane], s[9, lane]))
        for i in range(3):
            total[6 + i, lane] += wrap(euler[i] - row[6 + i]) ** 2
