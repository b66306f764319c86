"""The compiler of all kernels of the bench: ``from testbed.kernels import njit``, never from numba.

Lanes teach operators and functions of numpy a new type, and what numba compiled while they were known refers to them. So
they have to be known before anything is compiled or loaded from the cache: numba 0.68 ends with a KeyError where an
operator learns a type between the typing and the lowering of a function that uses it.
"""

from numba import cfunc as cfunc
from numba import njit as njit

from testbed.kernels import lane_functions as lane_functions
from testbed.kernels import lanes as lanes
from testbed.kernels import tables as tables
