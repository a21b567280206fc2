# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Compilation: how kernels are compiled by Numba, and the types of their arguments."""

from __future__ import annotations

import importlib
from typing import Any, Callable, TypeVar

import llvmlite.binding as llvm
import numba
from numba.extending import intrinsic, overload
from numba.np import arrayobj

from dlo_calibration.simulation.machine_code import Compiled, encoded, fields_of, Kernel

Function = TypeVar('Function', bound=Callable[..., Any])
types: Any = numba.types
_DEFINED: dict[Kernel, tuple[Any, bool]] = {}  # -> the function, and whether it returns anything


def part(kernel: Function) -> Function:
    """Compile a function together with the kernels that call it."""
    options: dict[str, Any] = {'_nrt': False}  # parts make no arrays: references to them need not be counted
    compile_: Any = numba.njit(error_model='numpy', **options)
    return compile_(kernel)  # type: ignore[no-any-return]


def of_numbers(kernel: Function) -> Function:
    """Compile a part in which no number is nan, so that the least of many is found four at once."""
    options: dict[str, Any] = {'_nrt': False, 'fastmath': {'nnan', 'nsz'}}
    compile_: Any = numba.njit(error_model='numpy', **options)
    return compile_(kernel)  # type: ignore[no-any-return]


def inlined(kernel: Function) -> Function:
    """
    Compile a function as a piece of the kernels that call it, in their loops.

    A call would push all words of its arrays, hundreds for a `Move`, at each step.
    """
    compile_: Any = numba.njit(inline='always', error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


def one_or_each(function: Callable[..., Any]) -> Callable[[Function], Function]:
    """Compile `function` as what the decorated one returns for the types: for one DLO, or for each lane."""
    def register(choose: Function) -> Function:
        overload(function, strict=False, inline='never', jit_options={
            'error_model': 'numpy', '_nrt': False})(choose)
        return choose
    return register


def entry(kernel: Kernel) -> Callable[[Function], Function]:
    """
    Let the decorated function be a kernel that Python calls.

    :raises TypeError: if its annotations are not those of the kernel.
    """
    def define(function: Function) -> Function:
        given, wanted = ([*{**one.__annotations__, 'return': 'int'}.items()] for one in (function, kernel))
        if given != wanted:
            raise TypeError(f'{kernel.name} is declared with {wanted}, and defined with {given}')
        compiled = part(function)
        _DEFINED[kernel] = compiled, function.__annotations__['return'] != 'None'
        return compiled
    return define


def machine_code(module: str) -> bytes:
    """Compile the kernels that a module defines and Python calls; return the machine code in one piece."""
    importlib.import_module(module)
    return encoded([_compiled(kernel, *how) for kernel, how in _DEFINED.items() if kernel.module == module])


def _compiled(kernel: Kernel, function: Any, answers: bool) -> Compiled:
    """Compile a function that takes the address of words, and calls another with what they tell."""
    kinds = types.Tuple([_type(layout) for _, layout in kernel.fields])

    @intrinsic
    def arguments(_: Any, address: Any) -> Any:
        def emit(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
            words = builder.bitcast(values[0], context.get_value_type(types.int64).as_pointer())
            return _unpacked(context, builder, words, kinds, 0)[0]
        return kinds(address), emit

    def without_answer(address: Any) -> int:
        function(*arguments(address))
        return 0

    def with_answer(address: Any) -> int:
        return int(function(*arguments(address)))

    call: Any = with_answer if answers else without_answer
    compile_: Any = numba.cfunc
    found = compile_(types.int64(types.voidptr), error_model='numpy', _nrt=False)(call)
    _, _, (code, _) = found._library.serialize_using_object_code()
    needed = [one.name for one in llvm.parse_assembly(found.inspect_llvm()).functions if one.is_declaration]
    return Compiled(kernel.name, found.native_name, needed, code)


def _type(layout: Any) -> Any:
    """Return the type of Numba for a layout of `states`."""
    if layout in (int, float):
        return types.int64 if layout is int else types.float64
    if isinstance(layout, list):
        return types.Tuple([_type(one) for one in layout])
    if isinstance(layout, type):
        return types.NamedTuple([_type(one) for _, one in fields_of(layout)], layout)
    dtype, axes = layout
    return types.Array(numba.from_dtype(dtype), axes, 'C')


def _unpacked(context: Any, builder: Any, words: Any, kind: Any, place: int) -> tuple[Any, int]:
    """Return the value of a type whose words begin at a place, and the place behind them."""
    def word(offset: int = 0) -> Any:
        return builder.load(builder.gep(words, [context.get_constant(types.intp, place + offset)]))

    if isinstance(kind, types.BaseTuple):
        values = []
        for one in kind:
            value, place = _unpacked(context, builder, words, one, place)
            values.append(value)
        return context.make_tuple(builder, kind, values), place
    if isinstance(kind, types.Array):
        data = context.get_data_type(kind.dtype)
        size = context.get_constant(types.intp, context.get_abi_sizeof(data))
        shape, strides = [word(1 + axis) for axis in range(kind.ndim)], [size]
        for length in shape[:0:-1]:
            strides.insert(0, builder.mul(strides[0], length))
        found = context.make_array(kind)(context, builder)
        pointer = builder.inttoptr(word(), data.as_pointer())
        arrayobj.populate_array(found, pointer, shape, strides, size, None)
        return found._getvalue(), place + 1 + kind.ndim
    if kind == types.float64:
        return builder.bitcast(word(), context.get_value_type(kind)), place + 1
    return word(), place + 1
