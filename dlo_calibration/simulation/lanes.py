# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Lanes: four numbers that a kernel treats as one, so that it simulates four DLOs in the time of one.

A processor adds four pairs of numbers as fast as one pair, and the equations of a chain are solved node
after node, so that a single DLO leaves it waiting.  A kernel's source is the same for one DLO and for
four: it is compiled for numbers, or for `LANES`.  Each lane gets the bits that a single DLO gets.

Where lanes differ in what they do, a kernel computes both and chooses with `where`, under `some`, so
that a single DLO does not compute what it does not need.
"""

from __future__ import annotations

import math
import operator
from typing import Any

from llvmlite import ir
import numba
from numba.core import cgutils
from numba.core.typeconv import Conversion
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model, type_callable
from numba.np import arrayobj

from dlo_calibration.simulation.states import COUNT

types: Any = numba.types
_VECTOR = ir.VectorType(ir.DoubleType(), COUNT)
_CHOICES = ir.VectorType(ir.IntType(1), COUNT)


class LanesType(types.Type):
    """The type of `COUNT` numbers."""

    def __init__(self) -> None:
        super().__init__('lanes')

    def can_convert_from(self, _: Any, other: Any) -> Conversion | None:
        """Let a number stand for the same number in each lane."""
        return Conversion.safe if isinstance(other, (types.Float, types.Integer)) else None

    def unify(self, _: Any, other: Any) -> LanesType | None:
        """Return the type of a variable that is a number here and lanes there."""
        return self if isinstance(other, (types.Float, types.Integer)) else None


class MaskType(types.Type):
    """The type of `COUNT` answers."""

    def __init__(self) -> None:
        super().__init__('mask')

    def can_convert_from(self, _: Any, other: Any) -> Conversion | None:
        """Let an answer stand for the same answer in each lane."""
        return Conversion.safe if isinstance(other, types.Boolean) else None

    def unify(self, _: Any, other: Any) -> MaskType | None:
        """Return the type of a variable that is one answer here and a mask there."""
        return self if isinstance(other, types.Boolean) else None


LANES, MASK = LanesType(), MaskType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _CHOICES)


def _splat(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    """Return a number as lanes."""
    if kind == LANES:
        return value
    return _repeated(builder, context.cast(builder, value, kind, types.float64), _VECTOR)


def _repeated(builder: Any, value: Any, vector: Any) -> Any:
    found = ir.Constant(vector, ir.Undefined)
    for lane in range(COUNT):
        found = builder.insert_element(found, value, ir.IntType(32)(lane))
    return found


@lower_cast(types.Float, LanesType)
@lower_cast(types.Integer, LanesType)
def _as_lanes(context: Any, builder: Any, given: Any, _: Any, value: Any) -> Any:
    return _splat(context, builder, value, given)


@lower_cast(types.Boolean, MaskType)
def _as_mask(_context: Any, builder: Any, _given: Any, _: Any, value: Any) -> Any:
    return _repeated(builder, value, _CHOICES)


def _number(kind: Any) -> bool:
    return isinstance(kind, (LanesType, types.Float, types.Integer))


def _operation(symbol: Any, result: Any, emit: Any) -> None:
    @type_callable(symbol)
    def typed(_: Any) -> Any:
        def of(one: Any, two: Any) -> Any:
            return result if LANES in (one, two) and _number(one) and _number(two) else None
        return of

    def lowered(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return emit(builder, *(_splat(context, builder, value, kind)
                               for value, kind in zip(values, signature.args, strict=True)))

    for pair in ((LanesType, LanesType), (LanesType, types.Float), (types.Float, LanesType),
                 (LanesType, types.Integer), (types.Integer, LanesType)):
        lower_builtin(symbol, *pair)(lowered)


for _name, _emit in {'add': ir.IRBuilder.fadd, 'sub': ir.IRBuilder.fsub, 'mul': ir.IRBuilder.fmul,
                     'truediv': ir.IRBuilder.fdiv}.items():
    for _symbol in (getattr(operator, _name), getattr(operator, f'i{_name}')):
        _operation(_symbol, LANES, _emit)
_operation(operator.lt, MASK, lambda builder, one, two: builder.fcmp_ordered('<', one, two))
_operation(operator.le, MASK, lambda builder, one, two: builder.fcmp_ordered('<=', one, two))
_operation(operator.gt, MASK, lambda builder, one, two: builder.fcmp_ordered('>', one, two))
# The order of comparison is that of Numba's max and min of two numbers.
_operation(max, LANES, lambda builder, one, two: builder.select(
    builder.fcmp_ordered('>', two, one), two, one))
_operation(min, LANES, lambda builder, one, two: builder.select(
    builder.fcmp_ordered('<', two, one), two, one))


def _function(symbol: Any, emit: Any) -> None:
    @type_callable(symbol)
    def typed(_: Any) -> Any:
        def of(one: Any) -> Any:
            return LANES if one == LANES else None
        return of

    @lower_builtin(symbol, LanesType)
    def lowered(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return emit(builder, values[0])


def _llvm(name: str) -> Any:
    def emit(builder: Any, value: Any) -> Any:
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f'llvm.{name}.v{COUNT}f64')
        return builder.call(function, [value])
    return emit


_function(operator.neg, lambda builder, value: builder.fneg(value))
_function(math.sqrt, _llvm('sqrt'))
_function(abs, _llvm('fabs'))


@intrinsic
def some(_: Any, mask: Any) -> Any:
    """Tell whether a condition holds in one lane at least."""
    def emit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        if mask != MASK:
            return values[0]
        bits = builder.bitcast(values[0], ir.IntType(COUNT))
        return builder.icmp_unsigned('!=', bits, ir.Constant(ir.IntType(COUNT), 0))
    return types.boolean(mask), emit


@intrinsic
def every(_: Any, mask: Any) -> Any:
    """Tell whether a condition holds in all lanes."""
    def emit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        if mask != MASK:
            return values[0]
        bits = builder.bitcast(values[0], ir.IntType(COUNT))
        return builder.icmp_unsigned('==', bits, ir.Constant(ir.IntType(COUNT), 2**COUNT - 1))
    return types.boolean(mask), emit


@intrinsic
def both(_: Any, one: Any, two: Any) -> Any:
    """Return where two conditions hold."""
    def emit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return builder.and_(*values)
    return one(one, two), emit


@intrinsic
def where(_: Any, mask: Any, one: Any, two: Any) -> Any:
    """Return `one` where a condition holds, else `two`."""
    kind = LANES if mask == MASK else types.float64

    def emit(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return builder.select(values[0], context.cast(builder, values[1], one, kind),
                              context.cast(builder, values[2], two, kind))
    return kind(mask, one, two), emit


@intrinsic
def finite(_: Any, value: Any) -> Any:
    """Return where a number is finite."""
    def emit(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        size = context.get_function(abs, value(value))(builder, values)
        infinity = context.cast(builder, context.get_constant(types.float64, math.inf), types.float64, value)
        return builder.fcmp_ordered('<', size, infinity)
    return (MASK if value == LANES else types.boolean)(value), emit


@intrinsic
def cosine_and_sine(_: Any, angle: Any) -> Any:
    """Return cosine and sine of an angle [rad]."""
    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        found = []
        for function in (math.cos, math.sin):
            of_one = context.get_function(function, types.float64(types.float64))
            if angle != LANES:
                found.append(of_one(builder, values))
                continue
            vector = values[0]
            for lane in range(COUNT):
                place = ir.IntType(32)(lane)
                vector = builder.insert_element(
                    vector, of_one(builder, [builder.extract_element(values[0], place)]), place)
            found.append(vector)
        return context.make_tuple(builder, signature.return_type, found)
    return types.UniTuple(angle, 2)(angle), emit


@intrinsic
def lanes_of(_: Any, numbers: Any) -> Any:
    """Return an array (..., COUNT) of numbers as the array (...) of lanes in the same memory."""
    kind = types.Array(LANES, numbers.ndim - 1, 'C', aligned=False)  # NumPy aligns it to one number only

    def emit(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        given = context.make_array(numbers)(context, builder, values[0])
        found = context.make_array(kind)(context, builder)
        pointer = builder.bitcast(given.data, context.get_data_type(LANES).as_pointer())
        shape = cgutils.unpack_tuple(builder, given.shape, numbers.ndim)[:-1]
        strides = cgutils.unpack_tuple(builder, given.strides, numbers.ndim)[:-1]
        arrayobj.populate_array(found, pointer, shape, strides,
                                context.get_constant(types.intp, 8 * COUNT), None)
        return found._getvalue()
    return kind(numbers), emit


@intrinsic
def numbers_of(_: Any, lanes: Any) -> Any:
    """Return an array (...) of lanes as the array (..., COUNT) of numbers in the same memory."""
    kind = types.Array(types.float64, lanes.ndim + 1, 'C')

    def emit(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        given = context.make_array(lanes)(context, builder, values[0])
        found = context.make_array(kind)(context, builder)
        pointer = builder.bitcast(given.data, context.get_data_type(types.float64).as_pointer())
        count, size = context.get_constant(types.intp, COUNT), context.get_constant(types.intp, 8)
        shape = [*cgutils.unpack_tuple(builder, given.shape, lanes.ndim), count]
        strides = [*cgutils.unpack_tuple(builder, given.strides, lanes.ndim), size]
        arrayobj.populate_array(found, pointer, shape, strides, size, None)
        return found._getvalue()
    return kind(lanes), emit
