# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Machine code: kernels as Python calls them.

Numba compiles them once per machine (`compilation`), and `kernel_cache` keeps what comes of it.  LLVM alone
loads it, in a twentieth of the time that Numba takes to load itself and its own cache.

A kernel takes one argument: the address of 64-bit words that tell where its arrays are and how large, one
after the other, in the order of its annotations, which `states` explains.
"""

from __future__ import annotations

from array import array
from contextlib import suppress
import ctypes
from functools import cache, update_wrapper
import hashlib
import json
from pathlib import Path
import struct
import threading
from typing import Any, Callable, Iterable, Mapping, NamedTuple, Sequence

import numpy as np

from dlo_calibration.simulation.kernel_cache import compile_kernels, is_compiled
from dlo_calibration.simulation.states import LAYOUTS

_start, _address = ctypes.c_char.from_buffer, ctypes.addressof
_write_number = struct.Struct('d').pack_into
_write_array = [struct.Struct(f'{1 + axes}q').pack_into for axes in range(4)]  # address and shape
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
_LIBRARY = ctypes.CDLL(None)  # the process, with the libraries of C and Python
#: Numba's functions that raise what a kernel raised; ours raise nothing
_RAISING = {'numba_do_raise', 'numba_gil_ensure', 'numba_gil_release', 'numba_runtime_build_excinfo_struct',
            'numba_unpickle'}
_Place = tuple[int, Any]  # of a field: its first word, and its layout
_LOCK = threading.RLock()
_KERNELS: dict[str, list[Kernel]] = {}  # by the module in which they are defined
_ENGINES: list[Any] = []  # they own the functions


class Packed:
    """
    A state as kernels take it; it keeps the arrays of the state alive.

    :raises TypeError: if an array is not what the state's annotations tell.
    """

    __slots__ = ('_fields', 'kind', 'words')

    def __init__(self, state: Any) -> None:
        self.kind: type = type(state)
        self.words = _room(_size(self.kind))
        self._fields: dict[str, Any] = {}
        self.set(**state._asdict())

    @property
    def state(self) -> Any:
        """The state; what is nested in it may be `Packed`, too."""
        return self.kind(**self._fields)

    def __getitem__(self, name: str) -> Any:
        """Return a field of the state."""
        return self._fields[name]

    def set(self, **values: Any) -> None:
        """
        Give fields of the state other values; those that are nested may be `Packed`.

        :raises TypeError: if an array is not what the state's annotations tell.
        """
        places, fields = _places_of(self.kind), self._fields
        for name, value in values.items():
            if value is not fields.get(name) or type(value) is Packed:
                start, layout = places[name]
                _write(self.words, start, name, value, layout)
        fields.update(values)


class Kernel:
    """
    A kernel that Python can call; it is loaded, and compiled if it must be, at the first call.

    It takes what the annotations of `declared` tell, a state also `Packed`, and returns an integer.

    :param module: in which it is defined.
    """

    def __init__(self, module: str, declared: Callable[..., int]) -> None:
        update_wrapper(self, declared)
        words = dict(declared.__annotations__)
        del words['return']
        self.name = declared.__name__
        self.fields = tuple((name, LAYOUTS[word]) for name, word in words.items())
        self._places = _places(self.fields)
        self._size = sum(_size(layout) for _, layout in self.fields)
        self.module = module
        self._function: Callable[[int], int] = self._load

    def __call__(self, *values: Any) -> int:
        """
        Execute the kernel.

        :raises TypeError: if an array is not what the annotations tell.
        """
        words = _room(self._size)
        _write_all(words, 0, values, self._places)
        return self._function(words.buffer_info()[0])

    @property
    def ready(self) -> bool:
        """Whether a call need not compile it."""
        return self._function != self._load or is_compiled(self.module)

    def _load(self, address: int) -> int:
        """Load all kernels of the module, and execute this one."""
        load(self.module)
        return self._function(address)


def defined_in(module: str) -> Callable[[Callable[..., int]], Kernel]:
    """Let a function be the kernel of the same name that a module defines."""
    def declare(declared: Callable[..., int]) -> Kernel:
        kernel = Kernel(module, declared)
        _KERNELS.setdefault(module, []).append(kernel)
        return kernel
    return declare


def load(module: str) -> None:
    """
    Load the kernels that a module defines; compile them first if they are not compiled.

    :raises DloCalibrationError: if they cannot be compiled.
    """
    with _LOCK:
        try:
            functions = loaded(compile_kernels(module))
        except ValueError:  # a disk was full, or worse
            compile_kernels(module).unlink()
            functions = loaded(compile_kernels(module))
        for kernel in _KERNELS.get(module, []):
            kernel._function = functions[kernel.name]


class Compiled(NamedTuple):
    """
    A kernel that was compiled.

    :param symbol: of its function.
    :param needed: names of functions that it calls, or LLVM's instructions that may become calls.
    :param code: the object file that contains it.
    """

    name: str
    symbol: str
    needed: list[str]
    code: bytes


def encoded(kernels: Sequence[Compiled]) -> bytes:
    """Return what a file with machine code contains: a line of JSON, and one object file after the other."""
    body = b''.join(one.code for one in kernels)
    head = {'sha256': hashlib.sha256(body).hexdigest(),
            'kernels': [[one.name, one.symbol, one.needed, len(one.code)] for one in kernels]}
    return json.dumps(head).encode() + b'\n' + body


def loaded(file: Path) -> dict[str, Callable[[int], int]]:
    """
    Load a file with machine code; return its functions by the names of the kernels.

    :raises ValueError: if the file is not what `encoded` returned.
    """
    import llvmlite.binding as llvm

    line, _, body = file.read_bytes().partition(b'\n')
    head = json.loads(line)
    if hashlib.sha256(body).hexdigest() != head['sha256']:
        raise ValueError(f'{file}: the machine code is damaged')
    with suppress(RuntimeError):  # newer ones do this by themselves, and say so
        llvm.initialize()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    for name in {name for _, _, needed, _ in head['kernels'] for name in needed}:
        _add_symbol(llvm, name)
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(''), machine)
    start = 0
    for _, _, _, size in head['kernels']:
        engine.add_object_file(llvm.ObjectFileRef.from_data(body[start:start + size]))
        start += size
    engine.finalize_object()
    _ENGINES.append(engine)
    return {name: _FUNCTION(engine.get_function_address(symbol)) for name, symbol, _, _ in head['kernels']}


def _add_symbol(llvm: Any, name: str) -> None:
    """
    Tell LLVM where a function is that machine code calls.

    :raises ValueError: if there is none.
    """
    instruction = name.startswith('llvm.')
    name = name.split('.')[1] if instruction else name
    for one in (name, 'sincos') if name in ('sin', 'cos') else (name,):  # LLVM joins the two where it can
        if llvm.address_of_symbol(one) is not None:  # Numba is loaded, too: its own functions must stay
            continue
        function = getattr(_LIBRARY, 'abort' if one in _RAISING else one, None)
        if function is not None:
            llvm.add_symbol(one, ctypes.cast(function, ctypes.c_void_p).value)
        elif not instruction:
            raise ValueError(f'a kernel calls {one}, which only Numba has')


def _room(size: int) -> array[int]:
    """Return as many words, which are not known yet."""
    return array('q', bytes(8 * size))


def _write_all(words: array[int], start: int, values: Iterable[Any], places: Mapping[str, _Place]) -> None:
    """Write the words of values one after the other, from a word on."""
    for value, (name, (place, layout)) in zip(values, places.items(), strict=True):
        _write(words, start + place, name, value, layout)


def _write(words: array[int], start: int, name: str, value: Any, layout: Any) -> None:
    """Write the words of a value to a place."""
    kind: Any = type(value)
    if kind is np.ndarray and type(layout) is tuple:
        if (value.dtype, value.ndim) != layout or not value.flags.carray:
            raise TypeError(f'{name} is an array of {value.dtype} with {value.ndim} axes; a kernel takes '
                            f'one of {layout[0]} with {layout[1]}, in one piece and not read-only')
        _write_array[value.ndim](
            words, 8 * start, _address(_start(value)) if value.size else 0, *value.shape)
    elif kind is Packed and value.kind is layout:
        words[start:start + len(value.words)] = value.words
    elif layout is int:
        words[start] = int(value)
    elif layout is float:
        _write_number(words, 8 * start, value)
    elif type(layout) is list:
        for k, (one, state) in enumerate(zip(value, layout, strict=True)):
            _write(words, start + k * _size_of(state), name, one, state)
    elif kind is layout:
        _write_all(words, start, value, _places_of(layout))
    else:
        raise TypeError(f'{name} is of {kind.__name__}; a kernel takes {layout}')


def _places(fields: Iterable[tuple[str, Any]]) -> dict[str, _Place]:
    """Return where the words of each field begin, and its layout, by name."""
    found, start = {}, 0
    for name, layout in fields:
        found[name] = start, layout
        start += _size(layout)
    return found


@cache
def _places_of(state: type) -> dict[str, _Place]:
    return _places(fields_of(state))


def _size(layout: Any) -> int:
    """Return the number of words of a value."""
    if isinstance(layout, list):
        return sum(map(_size, layout))
    if isinstance(layout, tuple):
        return 1 + int(layout[1])
    return 1 if layout in (int, float) else _size_of(layout)


@cache
def _size_of(state: type) -> int:
    return sum(_size(layout) for _, layout in fields_of(state))


@cache
def fields_of(state: type) -> tuple[tuple[str, Any], ...]:
    """Return names and layouts of the fields of a state."""
    return tuple((name, LAYOUTS[word.__forward_arg__]) for name, word in state.__annotations__.items())
