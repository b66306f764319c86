"""Quaternions in arrays, scalar first, for drivers of packages that give whole tracks or sets of sigma points at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def products(p: Array, q: Array) -> Array:
    """Hamilton products (...,4)."""
    vector = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])
    scalar = p[..., :1] * q[..., :1] - np.sum(p[..., 1:] * q[..., 1:], axis=-1, keepdims=True)
    return np.concatenate([scalar, vector], axis=-1)


def conjugates(q: Array) -> Array:
    """(...,4)."""
    return np.asarray(q * [1.0, -1.0, -1.0, -1.0])


def of_rotations(rotation: Array) -> Array:
    """(...,4) of rotation vectors (...,3), rad."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    return np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * rotation], axis=-1)


def to_rotations(q: Array) -> Array:
    """(...,3) rotation vectors, rad, of unit quaternions (...,4): the shorter way round."""
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    return np.asarray(q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0))


def about_down(angle: Array) -> Array:
    """(...,4) of turns by angles (...), rad, about the third axis."""
    none = np.zeros_like(angle)
    return np.stack([np.cos(0.5 * angle), none, none, np.sin(0.5 * angle)], axis=-1)
