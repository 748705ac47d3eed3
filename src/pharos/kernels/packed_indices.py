"""`PackedIndices` in compiled loops: arrays that are read like those of int64, entry by entry.

So a loop over `next_states[s, a]` is written once, and Numba compiles it for each width of the indices; what it makes
of int32 and int64 stays what it is. They cannot be written to here, nor returned.
"""

import operator

import numpy as np
from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import (
    NativeValue,
    make_attribute_wrapper,
    models,
    overload,
    overload_attribute,
    register_model,
    unbox,
)

from pharos.system.packed_indices import PACKED, PackedIndices


class PackedIndicesType(types.Type):
    """Numba's type of them, by the number of dimensions."""

    def __init__(self, ndim):
        self.entries = types.Array(from_dtype(PACKED), ndim, "C", readonly=True)
        super().__init__(name=f"pharos.PackedIndices({ndim})")


@register_model(PackedIndicesType)
class _PackedIndicesModel(models.StructModel):
    def __init__(self, manager, indices_type):
        super().__init__(manager, indices_type, [("entries", indices_type.entries)])


make_attribute_wrapper(PackedIndicesType, "entries", "entries")


@unbox(PackedIndicesType)
def _unboxed(indices_type, indices, c):
    array = c.pyapi.object_getattr_string(indices, "packed")
    entries = c.unbox(indices_type.entries, array)
    c.pyapi.decref(array)  # the object keeps it
    result = cgutils.create_struct_proxy(indices_type)(c.context, c.builder)
    result.entries = entries.value
    return NativeValue(result._getvalue(), is_error=entries.is_error, cleanup=entries.cleanup)


@overload(operator.getitem, jit_options={"forceinline": True})
def _getitem(indices, where):
    if not isinstance(indices, PackedIndicesType):
        return None

    def entry(indices, where):
        parts = indices.entries[where]
        return np.int64(parts.high) << 32 | np.int64(parts.low)

    return entry


@overload_attribute(PackedIndicesType, "shape")
def _shape(indices):
    return lambda indices: indices.entries.shape


@overload(len)
def _length(indices):
    if isinstance(indices, PackedIndicesType):
        return lambda indices: len(indices.entries)
    return None


def _type_of(indices):
    return PackedIndicesType(indices.ndim)


PackedIndices._numba_type_ = property(_type_of)  # type: ignore[attr-defined]
