# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Digests of values, which identify evaluations and calibrations, of source code and of files."""

from __future__ import annotations

from collections.abc import Mapping  # with typing.Mapping, isinstance is ten times slower
from dataclasses import fields, is_dataclass
import functools
from hashlib import blake2b, file_digest
from pathlib import Path
from typing import Any, Iterable

import numpy as np

from dlo_calibration.simulation.core import _core


def digest(*values: Any) -> str:
    """
    Return a digest of values, arrays and dataclasses; it is the same in every process and on every machine.

    :raises TypeError: for any other type.
    """
    state = blake2b(digest_size=16)
    _feed(state, values)
    return state.hexdigest()


@functools.cache
def code_digest(rooms: tuple[str, ...]) -> str:
    """Return a digest of the Python code of some rooms of this package, and of the compiled core."""
    package = Path(__file__).parents[1]
    files = [file for room in rooms for file in sorted((package / room).glob('*.py'))]
    return digest(*(file.read_bytes() for file in (*files, Path(_core.__file__))))


def file_digests(paths: Iterable[Path]) -> dict[str, str]:
    """
    Return the SHA-256 of files, as `sha256sum` prints it, by file name.

    A name has no folders but those that distinguish it from the name of another file.

    :raises OSError: if a file cannot be read.
    """
    digests: dict[str, str] = {}
    for path in paths:
        with path.open('rb') as stream:
            sha256 = file_digest(stream, 'sha256').hexdigest()
        parts = path.absolute().parts
        for count in range(1, len(parts)):
            if digests.setdefault('/'.join(parts[-count:]), sha256) == sha256:
                break
    return digests


def _feed(state: Any, value: Any) -> None:
    """Feed a value to a hash: its type, length and content."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str, bytes)):  # first, as most values are these
        text = value.hex() if isinstance(value, float) else value
        octets = text if isinstance(text, bytes) else str(text).encode('utf-8', 'surrogatepass')
        state.update(f'{type(value).__name__}{len(octets)}:'.encode() + octets)
    elif is_dataclass(value) and not isinstance(value, type):
        name = type(value).__name__
        _feed(state, {f'{name}.{field.name}': getattr(value, field.name) for field in fields(value)})
    elif isinstance(value, np.ndarray):
        value = np.ascontiguousarray(value, value.dtype.newbyteorder('<'))
        if value.dtype.hasobject:
            raise TypeError('an array of objects has no digest')
        _feed(state, (value.dtype.str, value.shape))
        state.update(value.tobytes())
    elif isinstance(value, Mapping):
        state.update(f'{{{len(value)}:'.encode())
        for name in sorted(value):
            _feed(state, (name, value[name]))
    elif isinstance(value, (tuple, list)):
        state.update(f'({len(value)}:'.encode())
        for item in value:
            _feed(state, item)
    else:
        raise TypeError(f'a {type(value).__name__} has no digest')
