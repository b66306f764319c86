"""Kernels that are written for arrays of floats do the same on tables of lanes, lane by lane."""

import numpy as np
import pytest
from numba import njit

from testbed.kernels.lanes import WIDTH, alike, any_of, select
from testbed.kernels.tables import Apart, apart, combined, of_lane, side_by_side, spread, zeros
from testbed.physics.rotations import euler_to_quat, quat_to_euler, wrap

RNG = np.random.default_rng(7)


@njit
def indexed(a, b, out):
    """Rows, slices, three axes, in-place operators, a fill, shape and reshape."""
    out[:] = 0.5
    part, row = a[1:3], b[1]
    for i in range(part.shape[0]):
        for j in range(a.shape[1]):
            out[i] += part[i, j] * row[j, 0]
            out[i] -= b[0, i, j] / 4.0
    square = out[2:6].reshape((2, 2))
    square[1, 0] = a[0, 0] - square[0, 1]
    square[0, 0] *= 3.0
    square[1, 1] /= -a[0, 1]


@njit
def chosen(x, y, out):
    """Comparisons, logic and choices, and a loop that any lane keeps going."""
    for i in range(x.shape[0]):
        inside = (x[i] > -0.5) & (x[i] <= 0.5) | (y[i] >= 1.0)
        out[i] = select(inside, x[i], select(x[i] != x[i], 7.0, -y[i]))
        if any_of(x[i] < -2.0):
            out[i] = select(x[i] < -2.0, alike(x[i], 3.0), out[i])


@njit
def functions(x, y, out):
    for i in range(x.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = np.sin(x[i]), np.cos(x[i]), np.tan(0.4 * x[i])
        out[i, 3], out[i, 4], out[i, 5] = np.arctan2(y[i], x[i]), np.hypot(x[i], y[i]), wrap(3.0 * x[i])
        out[i, 6], out[i, 7], out[i, 8] = np.exp(x[i]), np.log(abs(x[i])), np.sqrt(abs(y[i]))
        out[i, 9], out[i, 10], out[i, 11] = quat_to_euler(euler_to_quat(x[i], 0.45 * x[i], y[i]))


@njit
def left_behind(x, numbers, rows, squares):
    """One number per place, by one to three indices, into rooms and parts of them."""
    for k in range(rows.shape[0]):
        numbers[k] = x[k]
        row, square = rows[k], squares[k]
        for i in range(row.shape[0]):
            row[i] = x[k] + 1.0 * i
            for j in range(square.shape[1]):
                square[i, j] = x[k] * (1.0 * i) - 1.0 * j
        rows[k, 0] = -x[k]
        squares[k, 1, 1] = 5.0


def lanes_of(kernel, *inputs, out):
    """``out`` of a kernel on tables, and stacked of the same kernel on each lane alone."""
    table = zeros(*out)
    kernel(*(side_by_side(list(np.moveaxis(values, -1, 0))) for values in inputs), table)
    single = np.zeros((WIDTH, *out))
    for lane in range(WIDTH):
        kernel(*(np.ascontiguousarray(values[..., lane]) for values in inputs), single[lane])
    return np.moveaxis(table.array, -1, 0), single


def test_indices_are_those_of_arrays():
    a, b = RNG.normal(size=(4, 3, WIDTH)), RNG.normal(size=(2, 3, 3, WIDTH))
    table, single = lanes_of(indexed, a, b, out=(7,))
    np.testing.assert_array_equal(table, single)
    assert (single != 0.0).all()


def test_choices_are_made_lane_by_lane():
    x, y = 2.0 * RNG.normal(size=(50, WIDTH)), RNG.normal(size=(50, WIDTH))
    x[3, 2] = np.nan
    table, single = lanes_of(chosen, x, y, out=(50,))
    np.testing.assert_array_equal(table, single)
    assert single[2, 3] == 7.0 and 0.1 < np.mean(single == x.T) < 0.9


def test_functions_are_those_of_the_library():
    """To a few units in the last place of the result, or of 1 where that is larger: own series against the C library's."""
    x, y = RNG.uniform(-3.1, 3.1, size=(400, WIDTH)), RNG.uniform(-3.1, 3.1, size=(400, WIDTH))
    table, single = lanes_of(functions, x, y, out=(400, 12))
    np.testing.assert_allclose(table, single, rtol=2e-14, atol=2e-15)
    edges = np.array([[0.0, 1.0, -1.0, 0.0, 0.0, 2.0, -2.0, 1e-300]])
    table, single = lanes_of(functions, edges, edges[:, ::-1].copy(), out=(1, 12))
    np.testing.assert_allclose(table[..., 3], single[..., 3], rtol=4e-16)


def test_a_model_comes_back_out_of_its_lane():
    models = [(np.full((2, 3), float(k)), 4, (np.arange(3.0) + k,)) for k in range(5)]
    table = combined(models, frozenset(), frozenset())
    for lane in range(WIDTH):
        matrix, number, (row,) = of_lane(table, lane)
        np.testing.assert_array_equal(matrix, models[min(lane, 4)][0])
        np.testing.assert_array_equal(row, models[min(lane, 4)][2][0])
        assert number == 4 and matrix.flags.c_contiguous
    np.testing.assert_array_equal(spread([1.0, 2.0]).array, np.tile([[1.0], [2.0]], WIDTH))


@pytest.mark.parametrize("rows", [1, 3])
def test_rows_begin_on_cache_lines(rows):
    assert zeros(rows, 5).array.ctypes.data % 64 == 0


def test_what_lies_apart_is_each_lanes_own_array():
    x = RNG.normal(size=(3, WIDTH))
    shapes = (3,), (3, 4), (3, 4, 2)
    rooms = [apart(np.full(shape, np.nan), filled=True) for shape in shapes]
    left_behind(side_by_side(list(x.T)), *rooms)
    for lane in range(WIDTH):
        single = [np.full(shape, np.nan) for shape in shapes]
        left_behind(np.ascontiguousarray(x[:, lane]), *single)
        for one, room in zip(single, rooms, strict=True):
            assert np.array_equal(one, of_lane(room, lane))
            assert of_lane(room, lane).flags.c_contiguous
            assert np.shares_memory(of_lane(room, lane), room.array)


def test_a_room_apart_takes_numbers_alone():
    @njit
    def whole_row(room, x):
        room[0] = x

    with pytest.raises(Exception, match="setitem"):
        whole_row(Apart(np.zeros((WIDTH, 2, 2))), 1.0)
