# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Digests: of values, by which evaluations and calibrations are recognised; of source code; of files."""

from __future__ import annotations

from collections.abc import Mapping  # that of typing makes isinstance ten times slower
from dataclasses import fields, is_dataclass
import functools
from hashlib import blake2b, file_digest
from pathlib import Path
from typing import Any, Iterable

import numpy as np

from dlo_calibration.simulation.core import _core


def digest(*things: Any) -> str:
    """
    Return a digest of values, arrays and dataclasses that is the same in any process and on any machine.

    :raises TypeError: for a thing of another type.
    """
    state = blake2b(digest_size=16)
    _feed(state, things)
    return state.hexdigest()


@functools.cache
def code_digest(rooms: tuple[str, ...]) -> str:
    """Return a digest of the Python code of rooms of this package, and of the compiled core."""
    package = Path(__file__).parents[1]
    files = [file for room in rooms for file in sorted((package / room).glob('*.py'))]
    return digest(*(file.read_bytes() for file in (*files, Path(_core.__file__))))


def file_digests(paths: Iterable[Path]) -> dict[str, str]:
    """
    Return the SHA-256 of files, which `sha256sum` prints, too, by their name without folders.

    :raises OSError: if a file cannot be read.
    """
    digests = {}
    for path in paths:
        with path.open('rb') as stream:
            digests[path.name] = file_digest(stream, 'sha256').hexdigest()
    return digests


def _feed(state: Any, thing: Any) -> None:
    """Feed a thing to a hash: its type, its length, and its content."""
    if isinstance(thing, np.generic):
        thing = thing.item()
    if thing is None or isinstance(thing, (bool, int, float, str, bytes)):  # most things, so they come first
        kind = thing.hex() if isinstance(thing, float) else thing
        octets = thing if isinstance(thing, bytes) else str(kind).encode('utf-8', 'surrogatepass')
        state.update(f'{type(thing).__name__}{len(octets)}:'.encode() + octets)
    elif is_dataclass(thing) and not isinstance(thing, type):
        name = type(thing).__name__
        _feed(state, {f'{name}.{one.name}': getattr(thing, one.name) for one in fields(thing)})
    elif isinstance(thing, np.ndarray):
        thing = np.ascontiguousarray(thing, thing.dtype.newbyteorder('<'))
        if thing.dtype.hasobject:
            raise TypeError('an array of objects has no digest')
        _feed(state, (thing.dtype.str, thing.shape))
        state.update(thing.tobytes())
    elif isinstance(thing, Mapping):
        state.update(f'{{{len(thing)}:'.encode())
        for name in sorted(thing):
            _feed(state, (name, thing[name]))
    elif isinstance(thing, (tuple, list)):
        state.update(f'({len(thing)}:'.encode())
        for one in thing:
            _feed(state, one)
    else:
        raise TypeError(f'a {type(thing).__name__} has no digest')
