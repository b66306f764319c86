"""The arithmetic that no estimator can do without, as bare compiled loops: what the hot paths are measured against.

Each function repeats one piece ``count`` times on the data that it is given and returns something of the last result, so
that nothing can be left out by the compiler. SI units, radians.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from testbed.physics.rotations import quat_multiply, quat_rotate, rotvec_to_quat


@njit(cache=True)
def triple_products(phi, p, count):
    """P = Phi P Phi' by the matrix product of BLAS, as any plain covariance propagation does."""
    for _ in range(count):
        p = phi @ p @ phi.T
    return p


@njit(cache=True)
def strapdown_steps(gyro, accel, dt):
    """Per sample two rotation vectors to quaternions, their products with q, one vector rotated, sine, cosine and root.

    The turn of the body, the turn of the frame n, the velocity change in n, and the radii and rates at a latitude.
    """
    q, v, lat = (1.0, 0.0, 0.0, 0.0), np.zeros(3), 0.8
    for k in range(gyro.shape[0]):
        sine, cosine = np.sin(lat), np.cos(lat)
        radius = 6.4e6 / np.sqrt(1.0 - 6.7e-3 * sine * sine)
        frame = rotvec_to_quat((-7.3e-5 * cosine * dt, v[0] / radius * dt, 7.3e-5 * sine * dt))
        turn = rotvec_to_quat((gyro[k, 0] * dt, gyro[k, 1] * dt, gyro[k, 2] * dt))
        push = quat_rotate(q, (accel[k, 0] * dt, accel[k, 1] * dt, accel[k, 2] * dt))
        q = quat_multiply(frame, quat_multiply(q, turn))
        v[0] += push[0]
        v[1] += push[1]
        v[2] += push[2] + 9.8 * dt
        lat += v[0] / radius * dt
    return v, lat


@njit(cache=True)
def sigma_point_sums(p, count):
    """A Cholesky factor of P (n,n), its 2 n points, their mean, and the sum of the products of their deviations."""
    n = p.shape[0]
    mean, out = np.zeros(n), np.zeros((n, n))
    points = np.zeros((2 * n, n))
    for _ in range(count):
        factor = np.linalg.cholesky(p)
        for j in range(n):
            for i in range(n):
                points[j, i] = factor[i, j]
                points[n + j, i] = -factor[i, j]
        for i in range(n):
            mean[i] = 0.0
        for s in range(2 * n):
            for i in range(n):
                mean[i] += points[s, i] / (2 * n)
        for s in range(2 * n):
            for i in range(n):
                points[s, i] -= mean[i]
        out = points.T @ points
    return out


@njit(cache=True)
def matrix_vector_products(matrices, vectors, count):
    """y = W x for each pair (inputs, outputs) of a network, in single precision by BLAS."""
    total = np.float32(0.0)
    for _ in range(count):
        for m in range(len(matrices)):
            y = vectors[m] @ matrices[m]
            total += y[0]
    return total


@njit(cache=True)
def normal_equations(jacobian, count):
    """J'J and its Cholesky factor: one step of Gauss-Newton without the network."""
    n = jacobian.shape[1]
    damped = np.zeros((n, n))
    for _ in range(count):
        damped = jacobian.T @ jacobian
        for i in range(n):
            damped[i, i] += 1.0
        damped = np.linalg.cholesky(damped)
    return damped
