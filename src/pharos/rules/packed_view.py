"""Packed states that rules read and write as if they were arrays of integers.

A state of D small integers is stored in a few 64-bit words (rules/layout.py has the position of each component).
Unpacking 29 components, running a rule and packing them again costs three times the rule itself. So compiled rules get
a view instead: `state[i]` is a shift and a mask of a word on the stack, which LLVM keeps in a register when there is
one word.

Reading or writing outside the declared ranges does not corrupt a neighbour: the view notes the component in `fault` and
goes on with a harmless value; the caller looks at `fault` and stops.
"""

import operator
from typing import Any

import numba.extending
from llvmlite import ir
from numba import int64, types
from numba.core import cgutils
from numba.extending import models, overload, register_model

intrinsic: Any = numba.extending.intrinsic  # whose types would hide the types of the functions that it makes

_WORD = ir.IntType(64)
_REGISTER_WORDS = 8  # views on more words than this are in memory
_OFFSET, _MASK, _LOW, _SIZE = range(4)  # columns of the layout's table


class PackedView(types.Type):
    """Numba type of the view on `num_words` words: their address, the layout's table, and the fault.

    Words that are only read are an array on the stack. Words that are written one after the other are a vector, kept in
    a register: through memory each write would wait for the one before it.
    """

    def __init__(self, num_words: int, writable: bool):
        self.num_words, self.writable = num_words, writable
        self.in_register = writable and num_words <= _REGISTER_WORDS
        super().__init__(name=f"pharos.PackedView({num_words}, {writable})")

    @property
    def words_type(self) -> ir.Type:
        """The type of all words together, on the stack."""
        return ir.VectorType(_WORD, self.num_words) if self.in_register else ir.ArrayType(_WORD, self.num_words)


class _WordsPointer(types.Type):
    def __init__(self, view_type: PackedView):
        self.view_type = view_type
        super().__init__(name=f"{view_type.name}.words")


@register_model(_WordsPointer)
class _WordsPointerModel(models.PrimitiveModel):
    def __init__(self, manager, pointer_type):
        super().__init__(manager, pointer_type, pointer_type.view_type.words_type.as_pointer())


@register_model(PackedView)
class _PackedViewModel(models.StructModel):
    def __init__(self, manager, view_type):
        pointer = types.CPointer(types.uint64)
        words = ("words", _WordsPointer(view_type))
        super().__init__(manager, view_type, [words, ("fault", pointer), ("fields", pointer), ("length", types.uint64)])


def _new_view(view_type, words, fields):
    def codegen(context, builder, sig, args):
        view = cgutils.create_struct_proxy(view_type)(context, builder)
        view.words = cgutils.alloca_once(builder, view_type.words_type)
        view.fault = cgutils.alloca_once(builder, _WORD)
        builder.store(ir.Constant(_WORD, 0), view.fault)
        array = context.make_array(sig.args[1])(context, builder, args[1])
        view.fields = builder.bitcast(array.data, _WORD.as_pointer())
        view.length = cgutils.unpack_tuple(builder, array.shape)[0]
        return view._getvalue()

    return view_type(words, fields), codegen


@intrinsic
def packed_view(typing_context, words, fields):
    """A view on len(words) words of this stack frame, with the layout's table (D, 4) int64."""
    return _new_view(PackedView(len(words), True), words, fields)


@intrinsic
def read_only_view(typing_context, words, fields):
    """A view, as `packed_view`, on a state whose components are only read."""
    return _new_view(PackedView(len(words), False), words, fields)


def _view(context, builder, sig, args):
    return cgutils.create_struct_proxy(sig.args[0])(context, builder, args[0])


def _load_word(builder, view, view_type, k):
    if view_type.in_register:
        return builder.extract_element(builder.load(view.words), k)
    return builder.load(builder.gep(view.words, [ir.Constant(_WORD, 0), k]))


@intrinsic
def set_word(typing_context, view, k, value):
    """Set word k of the view."""

    def codegen(context, builder, sig, args):
        view = _view(context, builder, sig, args)
        if sig.args[0].in_register:
            builder.store(builder.insert_element(builder.load(view.words), args[2], args[1]), view.words)
        else:
            builder.store(args[2], builder.gep(view.words, [ir.Constant(_WORD, 0), args[1]]))
        return context.get_dummy_value()

    return types.void(view, types.int64, types.uint64), codegen


@intrinsic
def get_word(typing_context, view, k):
    """Word k of the view."""

    def codegen(context, builder, sig, args):
        return _load_word(builder, _view(context, builder, sig, args), sig.args[0], args[1])

    return types.uint64(view, types.int64), codegen


@intrinsic
def fault(typing_context, view):
    """0, or 1 + the component that was read or written outside its declared range (1 + D: no such component)."""

    def codegen(context, builder, sig, args):
        return builder.load(_view(context, builder, sig, args).fault)

    return types.int64(view), codegen


def _checked_component(builder, view, index):
    """The component `index` as in Python (negative from the end); component 0 and a fault if there is none."""
    checked = cgutils.alloca_once_value(builder, index)
    with builder.if_then(builder.icmp_unsigned(">=", index, view.length), likely=False):
        wrapped = builder.add(index, view.length)
        is_negative = builder.icmp_signed("<", index, ir.Constant(_WORD, 0))
        inside = builder.and_(is_negative, builder.icmp_unsigned("<", wrapped, view.length))
        builder.store(builder.select(inside, wrapped, ir.Constant(_WORD, 0)), checked)
        with builder.if_then(builder.not_(inside)):
            _note_fault(builder, view, view.length)
    return builder.load(checked)


def _note_fault(builder, view, component):
    builder.store(builder.add(component, ir.Constant(_WORD, 1)), view.fault)


def _column(builder, view, index, column):
    """One entry of the layout's row of a component."""
    address = builder.add(builder.shl(index, ir.Constant(_WORD, 2)), ir.Constant(_WORD, column))
    return builder.load(builder.gep(view.fields, [address]))


def _word_and_shift(builder, view, view_type, index):
    """The word of a component and its shift there."""
    offset = _column(builder, view, index, _OFFSET)
    if view_type.num_words == 1:
        return ir.Constant(_WORD, 0), offset
    return builder.lshr(offset, ir.Constant(_WORD, 6)), builder.and_(offset, ir.Constant(_WORD, 63))


@intrinsic
def _get_component(typing_context, view, index):
    def codegen(context, builder, sig, args):
        view = _view(context, builder, sig, args)
        index = _checked_component(builder, view, args[1])
        word, shift = _word_and_shift(builder, view, sig.args[0], index)
        field = builder.and_(_load_word(builder, view, sig.args[0], word), _column(builder, view, index, _MASK))
        return builder.add(_column(builder, view, index, _LOW), builder.lshr(field, shift))

    return types.int64(view, types.int64), codegen


@intrinsic
def _set_component(typing_context, view, index, value):
    def codegen(context, builder, sig, args):
        view = _view(context, builder, sig, args)
        index = _checked_component(builder, view, args[1])
        word, shift = _word_and_shift(builder, view, sig.args[0], index)
        mask = _column(builder, view, index, _MASK)
        offset = builder.sub(args[2], _column(builder, view, index, _LOW))
        # a value out of range becomes the lowest one, and a fault
        inside = builder.icmp_unsigned("<", offset, _column(builder, view, index, _SIZE))
        harmless = cgutils.alloca_once_value(builder, offset)
        with builder.if_then(builder.not_(inside), likely=False):
            _note_fault(builder, view, index)
            builder.store(ir.Constant(_WORD, 0), harmless)
        # replace the bits of the component in its word
        field = builder.shl(builder.load(harmless), shift)
        address = view.words
        if sig.args[0].in_register:
            field, mask = (_in_lane(builder, sig.args[0].num_words, word, bits) for bits in (field, mask))
        else:
            address = builder.gep(view.words, [ir.Constant(_WORD, 0), word])
        builder.store(builder.or_(builder.and_(builder.load(address), builder.not_(mask)), field), address)
        return context.get_dummy_value()

    return types.void(view, types.int64, types.int64), codegen


def _in_lane(builder, num_words, word, bits):
    """A vector with `bits` in lane `word`, elsewhere 0."""
    vector = ir.VectorType(_WORD, num_words)
    first, zero = ir.Constant(ir.IntType(32), 0), ir.Constant(vector, [0] * num_words)
    everywhere = ir.Constant(ir.VectorType(ir.IntType(32), num_words), [0] * num_words)
    word, bits = (
        builder.shuffle_vector(builder.insert_element(zero, value, first), zero, everywhere) for value in (word, bits)
    )
    lanes = ir.Constant(vector, list(range(num_words)))
    return builder.select(builder.icmp_unsigned("==", word, lanes), bits, zero)


@overload(operator.getitem)
def _getitem(view, index):
    if isinstance(view, PackedView) and isinstance(index, types.Integer | types.Boolean):
        return lambda view, index: _get_component(view, int64(index))


@overload(operator.setitem)
def _setitem(view, index, value):
    if isinstance(view, PackedView) and view.writable and isinstance(index, types.Integer | types.Boolean):
        return lambda view, index, value: _set_component(view, int64(index), int64(value))


@intrinsic
def _length(typing_context, view):
    def codegen(context, builder, sig, args):
        return _view(context, builder, sig, args).length

    return types.int64(view), codegen


@overload(len)
def _len(view):
    if isinstance(view, PackedView):
        return lambda view: _length(view)
