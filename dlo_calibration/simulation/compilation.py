# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Compilation: how kernels are compiled by Numba, and the types of their arguments."""

from __future__ import annotations

from typing import Any, Callable, TypeVar

import numba
from numba.extending import overload
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

# Annotations that tell the number of axes:
Vector = Floats
Matrix = Floats
Cube = Floats
Indices = NDArray[np.int64]
Contacts = NDArray[np.void]
IndexRows = NDArray[np.int64]
#: annotation -> the type that a kernel is compiled for
TYPES: dict[str, Any] = {
    'None': numba.void, 'bool': numba.boolean, 'int': numba.int64, 'float': numba.float64,
    'Vector': numba.float64[::1], 'Matrix': numba.float64[:, ::1], 'Cube': numba.float64[:, :, ::1],
    'Indices': numba.int64[::1], 'IndexRows': numba.int64[:, ::1]}


def record(record: Any) -> Any:
    """Let kernels take a named tuple; its annotations give the types of its fields."""
    make: Any = numba.types.NamedTuple
    TYPES[record.__name__] = make([TYPES[word.__forward_arg__] for word in record.__annotations__.values()],
                                  record)
    return record


def part(kernel: Kernel) -> Kernel:
    """Compile a function together with the kernels that call it."""
    options: dict[str, Any] = {'_nrt': False}  # parts make no arrays: references to them need not be counted
    compile_: Any = numba.njit(cache=True, nogil=True, error_model='numpy', **options)
    return compile_(kernel)  # type: ignore[no-any-return]


def of_numbers(kernel: Kernel) -> Kernel:
    """Compile a part in which no number is nan, so that the least of many is found four at once."""
    options: dict[str, Any] = {'_nrt': False, 'fastmath': {'nnan', 'nsz'}}
    compile_: Any = numba.njit(cache=True, nogil=True, error_model='numpy', **options)
    return compile_(kernel)  # type: ignore[no-any-return]


def inlined(kernel: Kernel) -> Kernel:
    """Compile a function as a piece of the kernels that call it, in their loops."""
    compile_: Any = numba.njit(inline='always', error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]


def one_or_each(function: Callable[..., Any]) -> Callable[[Kernel], Kernel]:
    """Compile `function` as what the decorated one returns for the types: for one DLO, or for each lane."""
    def register(choose: Kernel) -> Kernel:
        overload(function, strict=False, inline='never', jit_options={
            'nogil': True, 'error_model': 'numpy', '_nrt': False})(choose)
        return choose
    return register


def entry(kernel: Kernel) -> Kernel:
    """Compile a kernel at import, or load it from the cache: a rollout never waits for the compiler."""
    *arguments, returned = (TYPES[word] for word in kernel.__annotations__.values())
    compile_: Any = numba.njit(returned(*arguments), cache=True, nogil=True, error_model='numpy')
    return compile_(kernel)  # type: ignore[no-any-return]
