"""Arrays of lanes: in a kernel a `Table` is indexed like an array of floats, and gives `WIDTH` numbers side by side.

A kernel that keeps to indices, slices of the first axis and ``shape`` is written once for both: for float arrays a filter, for
tables `WIDTH` filters, each on its own recording. What differs from lane to lane is chosen by `select`, not by a branch.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.extending import (
    NativeValue,
    intrinsic,
    make_attribute_wrapper,
    models,
    overload,
    overload_attribute,
    overload_method,
    register_model,
    typeof_impl,
    unbox,
)
from numpy.typing import NDArray

from testbed.kernels.lanes import WIDTH, aligned, as_lanes, load, scatter, store


class Table:
    """An array (..., `WIDTH`) of which a kernel sees the leading axes; ``array`` (aligned, contiguous) is it for Python."""

    __slots__ = ("array",)

    def __init__(self, array: NDArray[np.float64]) -> None:
        self.array = array


class Apart:
    """Room (`WIDTH`, ...) for what filters leave behind: a kernel sets numbers of it by lanes, and each lane's lie together."""

    __slots__ = ("array",)

    def __init__(self, array: NDArray[np.float64]) -> None:
        self.array = array


def apart(values: NDArray[np.float64], filled: bool = False) -> Any:
    """Room for as much as ``values`` of every lane; ``filled``: it starts like them."""
    room = np.empty((WIDTH, *values.shape))
    if filled:
        room[:] = values
    return Apart(room)


def zeros(*shape: int) -> Any:
    """A table of zeros."""
    return Table(aligned(int(np.prod(shape))).reshape(*shape, WIDTH))


def spread(values: Any) -> Any:
    """A table that has the same numbers in each lane."""
    values = np.asarray(values, dtype=float)
    table = zeros(*values.shape)
    table.array[:] = values[..., None]
    return table


def side_by_side(values: Sequence[Any]) -> Any:
    """A table of up to `WIDTH` arrays of one shape, one per lane; lanes without one repeat the last."""
    first = np.asarray(values[0], dtype=float)
    table = zeros(*first.shape)
    if len(values) == 1:
        table.array[:] = first[..., None]
        return table
    for lane in range(WIDTH):
        table.array[..., lane] = values[min(lane, len(values) - 1)]
    return table


def combined(models: list[Any], shared: frozenset[str], fresh: frozenset[str]) -> Any:
    """One model of tables from those of some filters, NamedTuples of arrays that may hold others; a lane for each.

    Arrays of floats become tables, but for those in fields that are ``shared``, in all models alike. Of fields that are
    ``fresh``, written before they are read, all lanes start as in the first model. Whatever is no array is the first's.
    """
    first = models[0]
    if isinstance(first, np.ndarray) and first.dtype == np.float64:
        return side_by_side(models)
    if not isinstance(first, tuple):
        return first
    parts = []
    for k, name in enumerate(getattr(first, "_fields", [""] * len(first))):
        if name in shared:
            parts.append(first[k])
        else:
            parts.append(combined([model[k] for model in (models[:1] if name in fresh else models)], shared, fresh))
    return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)


def of_lane(model: Any, lane: int) -> Any:
    """The arrays of one filter of a `combined` model: copies, but for what lies `Apart`."""
    if isinstance(model, Apart):
        return model.array[lane]
    if isinstance(model, Table):
        return np.ascontiguousarray(model.array[..., lane])
    if not isinstance(model, tuple):
        return model
    parts = [of_lane(part, lane) for part in model]
    return type(model)(*parts) if hasattr(model, "_fields") else tuple(parts)


class TableType(types.Type):
    """A `Table` of so many axes."""

    def __init__(self, ndim: int) -> None:
        self.ndim = ndim
        self.data = types.Array(types.float64, ndim + 1, "C")
        super().__init__(name=f"table{ndim}x{WIDTH}")


@typeof_impl.register(Table)
def _type_of(value: Any, context: Any) -> Any:
    return TableType(value.array.ndim - 1)


@register_model(TableType)
class _TableModel(models.StructModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, [("data", kind.data)])


make_attribute_wrapper(TableType, "data", "data")


@unbox(TableType)
def _unbox(kind: Any, value: Any, context: Any) -> Any:
    data = context.pyapi.object_getattr_string(value, "array")
    native = context.unbox(kind.data, data)
    context.pyapi.decref(data)
    return NativeValue(_wrapped(context.context, context.builder, kind, native.value), is_error=native.is_error)


def _wrapped(context: Any, builder: Any, kind: Any, data: Any) -> Any:
    table = cgutils.create_struct_proxy(kind)(context, builder)
    table.data = data
    return table._getvalue()


@intrinsic
def as_table(typing_context: Any, data: Any) -> Any:
    """An array (..., `WIDTH`) as a table."""
    kind = TableType(data.ndim - 1)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return impl_ret_borrowed(context, builder, kind, _wrapped(context, builder, kind, args[0]))

    return kind(data), generate


@overload_attribute(TableType, "shape")
def _shape(table):
    if table.ndim == 1:
        return lambda table: (table.data.shape[0],)
    if table.ndim == 2:
        return lambda table: (table.data.shape[0], table.data.shape[1])
    return lambda table: (table.data.shape[0], table.data.shape[1], table.data.shape[2])


@overload_method(TableType, "reshape")
def _reshape(table, shape):
    if len(shape) == 2:
        return lambda table, shape: as_table(table.data.reshape((shape[0], shape[1], WIDTH)))
    return None


class ApartType(types.Type):
    """What is left of an `Apart` of ``ndim`` + ``taken`` axes, the first ``taken`` of which have an index."""

    def __init__(self, ndim: int, taken: int = 0) -> None:
        self.ndim, self.taken = ndim, taken
        self.data = types.Array(types.float64, ndim + taken + 1, "C")
        super().__init__(name=f"apart{ndim}of{ndim + taken}x{WIDTH}")


@typeof_impl.register(Apart)
def _type_of_apart(value: Any, context: Any) -> Any:
    return ApartType(value.array.ndim - 1)


@register_model(ApartType)
class _ApartModel(models.StructModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, [("data", kind.data), ("first", types.intp)])


make_attribute_wrapper(ApartType, "data", "data")
make_attribute_wrapper(ApartType, "first", "first")


@unbox(ApartType)
def _unbox_apart(kind: Any, value: Any, context: Any) -> Any:
    data = context.pyapi.object_getattr_string(value, "array")
    native = context.unbox(kind.data, data)
    context.pyapi.decref(data)
    room = cgutils.create_struct_proxy(kind)(context.context, context.builder)
    room.data, room.first = native.value, context.context.get_constant(types.intp, 0)
    return NativeValue(room._getvalue(), is_error=native.is_error)


@intrinsic
def _part(typing_context: Any, room: Any, first: Any) -> Any:
    """``room`` with an axis less, whose numbers begin ``first`` numbers after those of its lane."""
    kind = ApartType(room.ndim - 1, room.taken + 1)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = cgutils.create_struct_proxy(room)(context, builder, value=args[0])
        part = cgutils.create_struct_proxy(kind)(context, builder)
        part.data, part.first = whole.data, args[1]
        return impl_ret_borrowed(context, builder, kind, part._getvalue())

    return kind(room, types.intp), generate


@overload_attribute(ApartType, "shape")
def _shape_apart(room):
    first = 1 + room.taken
    if room.ndim == 1:
        return lambda room: (room.data.shape[first],)
    return lambda room: room.data.shape[first:]


def _axes(index: Any) -> int:
    """How many axes an index takes."""
    return len(index) if isinstance(index, types.BaseTuple) else 1


def _place(index: Any, shape: Any) -> Any:
    """Where the number of an index lies among those of a lane, which lie in order of rows."""
    raise NotImplementedError("for kernels alone")


@overload(_place)
def _place_in_kernel(index, shape):
    if _axes(index) == 1:
        return lambda index, shape: index
    if _axes(index) == 2:
        return lambda index, shape: index[0] * shape[1] + index[1]
    return lambda index, shape: (index[0] * shape[1] + index[1]) * shape[2] + index[2]


@overload(operator.getitem)
def _getitem(table, index):
    if isinstance(table, ApartType):
        return _part_of_apart(table, index)
    if not isinstance(table, TableType):
        return None
    if isinstance(index, types.SliceType):
        return lambda table, index: as_table(table.data[index])
    if _axes(index) < table.ndim:
        return lambda table, index: as_table(table.data[index])
    return lambda table, index: load(table.data, _place(index, table.data.shape))


@overload(operator.setitem)
def _setitem(table, index, value):
    if isinstance(table, ApartType):
        return _set_apart(table, index)
    if not isinstance(table, TableType):
        return None
    if isinstance(index, types.SliceType):

        def fill(table, index, value):
            part = as_table(table.data[index])
            rows = part.data.size // WIDTH
            for i in range(rows):
                store(part.data, i, as_lanes(value))

        return fill
    if _axes(index) < table.ndim:
        return None
    return lambda table, index, value: store(table.data, _place(index, table.data.shape), as_lanes(value))


def _part_of_apart(room: Any, index: Any) -> Any:
    """What an index of the first axis leaves; no number is read."""
    if not isinstance(index, types.Integer) or room.ndim == 1:
        return None
    if room.ndim == 2:
        return lambda table, index: _part(table, table.first + index * table.shape[1])
    return lambda table, index: _part(table, table.first + index * (table.shape[1] * table.shape[2]))


def _set_apart(room: Any, index: Any) -> Any:
    """One number of every lane; no more at once."""
    if _axes(index) < room.ndim:
        return None
    return lambda table, index, value: scatter(table.data, table.first + _place(index, table.shape), as_lanes(value))
