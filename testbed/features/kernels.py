"""Kernel of the Lipschitz quotients: the largest |dy| / |dx| over all pairs of samples.

He & Asada (1993), Proc. American Control Conference. Inputs are scaled; the quotients come back as logarithms.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit


@njit(cache=True)
def log_largest_quotients(x, y, count):
    """Natural logarithms (count,) of the largest quotients of ``x`` (N,m), ``y`` (N,); pairs with equal x are left out.

    The smallest kept value stands first in a binary heap, so that a pair which does not enter costs one comparison.
    """
    n, m = x.shape
    heap = np.full(count, 0.0)
    for i in range(n):
        for j in range(i):
            distance = 0.0
            for c in range(m):
                difference = x[i, c] - x[j, c]
                distance += difference * difference
            rise = (y[i] - y[j]) * (y[i] - y[j])
            if distance > 0.0 and rise > heap[0] * distance:
                heap[0] = rise / distance
                _sift_down(heap)
    out = np.empty(count)
    for k in range(count):
        out[k] = 0.5 * np.log(max(heap[k], 1e-300))
    return out


@njit(cache=True)
def _sift_down(heap):
    """Move the first value to its place in a heap whose smallest value stands first."""
    at, size = 0, heap.shape[0]
    while True:
        child = 2 * at + 1
        if child >= size:
            return
        if child + 1 < size and heap[child + 1] < heap[child]:
            child += 1
        if heap[at] <= heap[child]:
            return
        heap[at], heap[child] = heap[child], heap[at]
        at = child
