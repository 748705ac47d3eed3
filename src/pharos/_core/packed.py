"""A packed state that rules read and write as if it were an array of integers.

A state of D small integers is stored in a few 64-bit words (state_space/_packing.py says where each component sits).
Unpacking 29 components, running a rule and packing them again costs three times the rule itself. So compiled rules get a
view instead: `state[i]` is a shift and a mask of a word on the stack, which LLVM keeps in a register when there is one word.

Reading or writing outside the declared ranges does not corrupt a neighbour: the view notes the component in `fault` and
goes on with a harmless value; the caller looks at `fault` and stops.
"""

import operator

from llvmlite import ir
from numba import int64, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

_WORD = ir.IntType(64)
_U64_ARRAY = types.Array(types.uint64, 1, "C")
_I64_ARRAY = types.Array(types.int64, 1, "C")


class PackedView(types.Type):
    """Numba type of the view: pointers to the words, to the tables of the layout, and to the fault."""

    def __init__(self):
        super().__init__(name="pharos.PackedView")


PACKED_VIEW = PackedView()


@register_model(PackedView)
class _PackedViewModel(models.StructModel):
    def __init__(self, manager, view_type):
        pointer = types.CPointer(types.uint64)
        names = ("words", "fault", "word", "shift", "mask", "low", "size")
        members = [*((name, pointer) for name in names), ("length", types.uint64)]
        super().__init__(manager, view_type, members)


@intrinsic
def packed_view(typing_context, words, word, shift, mask, low, size):
    """A view on len(words) words of this stack frame, with the layout's tables, each (D,) of 64 bits."""
    count = len(words)
    signature = PACKED_VIEW(words, word, shift, mask, low, size)

    def codegen(context, builder, sig, args):
        view = cgutils.create_struct_proxy(PACKED_VIEW)(context, builder)
        words = cgutils.alloca_once(builder, ir.ArrayType(_WORD, count))
        view.words = builder.bitcast(words, _WORD.as_pointer())
        view.fault = cgutils.alloca_once(builder, _WORD)
        builder.store(ir.Constant(_WORD, 0), view.fault)
        for name, array_type, value in zip(
            ("word", "shift", "mask", "low", "size"), sig.args[1:], args[1:], strict=True
        ):
            array = context.make_array(array_type)(context, builder, value)
            setattr(view, name, builder.bitcast(array.data, _WORD.as_pointer()))
        array = context.make_array(sig.args[1])(context, builder, args[1])
        view.length = cgutils.unpack_tuple(builder, array.shape)[0]
        return view._getvalue()

    return signature, codegen


def _view(context, builder, value):
    return cgutils.create_struct_proxy(PACKED_VIEW)(context, builder, value)


@intrinsic
def set_word(typing_context, view, k, value):
    """Set word k of the view."""

    def codegen(context, builder, sig, args):
        builder.store(args[2], builder.gep(_view(context, builder, args[0]).words, [args[1]]))
        return context.get_dummy_value()

    return types.void(view, types.int64, types.uint64), codegen


@intrinsic
def get_word(typing_context, view, k):
    """Word k of the view."""

    def codegen(context, builder, sig, args):
        return builder.load(builder.gep(_view(context, builder, args[0]).words, [args[1]]))

    return types.uint64(view, types.int64), codegen


@intrinsic
def fault(typing_context, view):
    """0, or 1 + the component that was read or written outside its declared range (1 + D: no such component)."""

    def codegen(context, builder, sig, args):
        return builder.load(_view(context, builder, args[0]).fault)

    return types.int64(view), codegen


@intrinsic
def clear_fault(typing_context, view):
    """Forget the fault."""

    def codegen(context, builder, sig, args):
        builder.store(ir.Constant(_WORD, 0), _view(context, builder, args[0]).fault)
        return context.get_dummy_value()

    return types.void(view), codegen


def _checked_component(builder, view, index):
    """`index` as in Python (negative from the end); where there is no such component, component 0 and a fault."""
    negative = builder.icmp_signed("<", index, ir.Constant(_WORD, 0))
    index = builder.select(negative, builder.add(index, view.length), index)
    inside = builder.icmp_unsigned("<", index, view.length)
    _note_fault(builder, view, builder.not_(inside), view.length)
    return builder.select(inside, index, ir.Constant(_WORD, 0))


def _note_fault(builder, view, is_fault, component):
    found = builder.add(component, ir.Constant(_WORD, 1))
    builder.store(builder.select(is_fault, found, builder.load(view.fault)), view.fault)


def _field(builder, view, index):
    """Pointer to the word of a component, its shift, mask and lowest value."""
    table = [builder.load(builder.gep(column, [index])) for column in (view.word, view.shift, view.mask, view.low)]
    return builder.gep(view.words, [table[0]]), *table[1:]


@intrinsic
def _get_component(typing_context, view, index):
    def codegen(context, builder, sig, args):
        view = _view(context, builder, args[0])
        word, shift, mask, low = _field(builder, view, _checked_component(builder, view, args[1]))
        return builder.add(low, builder.and_(builder.lshr(builder.load(word), shift), mask))

    return types.int64(view, types.int64), codegen


@intrinsic
def _set_component(typing_context, view, index, value):
    def codegen(context, builder, sig, args):
        view = _view(context, builder, args[0])
        index = _checked_component(builder, view, args[1])
        word, shift, mask, low = _field(builder, view, index)
        offset = builder.sub(args[2], low)
        inside = builder.icmp_unsigned("<", offset, builder.load(builder.gep(view.size, [index])))
        _note_fault(builder, view, builder.not_(inside), index)
        field = builder.shl(builder.and_(offset, mask), shift)
        others = builder.and_(builder.load(word), builder.not_(builder.shl(mask, shift)))
        builder.store(builder.or_(others, field), word)
        return context.get_dummy_value()

    return types.void(view, types.int64, types.int64), codegen


@overload(operator.getitem)
def _getitem(view, index):
    if isinstance(view, PackedView) and isinstance(index, types.Integer | types.Boolean):
        return lambda view, index: _get_component(view, int64(index))


@overload(operator.setitem)
def _setitem(view, index, value):
    if isinstance(view, PackedView) and isinstance(index, types.Integer | types.Boolean):
        return lambda view, index, value: _set_component(view, int64(index), int64(value))


@intrinsic
def _length(typing_context, view):
    def codegen(context, builder, sig, args):
        return _view(context, builder, args[0]).length

    return types.int64(view), codegen


@overload(len)
def _len(view):
    if isinstance(view, PackedView):
        return lambda view: _length(view)
