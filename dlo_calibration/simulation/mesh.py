# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Meshes of a scene: the triangles of .obj and .stl files, checked.

No other parser sees such a file: that of PyBullet ends the process at an index out of range.
It gets a file that is written here.
"""

from __future__ import annotations

import os
import re
import stat
from typing import BinaryIO, Iterator

import numpy as np

from dlo_calibration.model.chain import Floats

KINDS = ('.obj', '.stl')
MOST_TRIANGLES = 200_000  # of all meshes of a scene: about 250 MB in Bullet
LARGEST_FILE = 64 * 2**20  # bytes; that many triangles need less
LONGEST_LINE = 10_000  # bytes; a face of a thousand corners fits
FURTHEST = 1e6  # m; Bullet computes meshes with 7 digits, so that 10 cm are lost there already

#: One triangle of a binary .stl file: its normal, which is not used, its corners and a colour.
_FACET = np.dtype([('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('colour', '<u2')])


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """
    Open a file for reading; refuse what could block for ever, such as a pipe.

    :raises OSError: if it cannot be opened, or is a directory, a pipe or a device.
    """
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError('a directory, a pipe or a device, not a file')
    return os.fdopen(number, 'rb')


def read_mesh(path: str) -> Floats:
    """
    Return the corners of the triangles of a mesh, (t, 3, 3) [m], in the order of the file.

    Polygons are cut into triangles from their first corner.

    :raises ValueError: if it is not a valid .obj or .stl file, or too large; the text says why.
    :raises OSError: if it cannot be read.
    """
    kind = os.path.splitext(path)[1].lower()
    if kind not in KINDS:
        raise ValueError(f'a file {kind or "without a suffix"}, which is not read')
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > LARGEST_FILE:
            raise ValueError(f'{size} bytes; at most {LARGEST_FILE} are read')
        triangles = _obj(stream) if kind == '.obj' else _stl(stream, size)
    if not len(triangles):
        raise ValueError('no triangle')
    if not (np.abs(triangles) <= FURTHEST).all():  # neither is NaN
        raise ValueError(f'a coordinate that is no number up to {FURTHEST:g}')
    return triangles.astype(float)


def stl_octets(triangles: Floats) -> bytes:
    """Return the binary .stl file of (t, 3, 3) [m] triangles as `read_mesh` returns them."""
    facets = np.zeros(len(triangles), _FACET)
    facets['corners'] = triangles
    return bytes(80) + len(triangles).to_bytes(4, 'little') + facets.tobytes()


def _obj(stream: BinaryIO) -> Floats:
    corners: list[float] = []
    faces: list[tuple[int, int, int]] = []
    for number, words in _lines(stream):
        try:
            if words[0] == b'v':
                x, y, z = words[1:4]
                corners += float(x), float(y), float(z)
            elif words[0] == b'f':
                first, *rest = (_index(word, len(corners) // 3) for word in words[1:])
                faces += ((first, *pair) for pair in zip(rest, rest[1:], strict=False))
        except ValueError as error:
            raise ValueError(f'line {number}: {str(error)[:80]}') from error
        if max(len(faces), len(corners) // 9) > MOST_TRIANGLES:
            raise ValueError(f'more than {MOST_TRIANGLES} triangles')
    indices = np.array(faces, int).reshape(-1, 3)
    count = len(corners) // 3
    if (indices >= count).any():
        raise ValueError(f'a face with vertex {indices.max() + 1} of {count}')
    triangles: Floats = _single(corners)[indices]
    return triangles


def _index(word: bytes, count: int) -> int:
    """Return the index of a vertex, from 0, in a word such as ``3/1/2``; -1 is the last one so far."""
    index = int(word.partition(b'/')[0])
    if not -count <= index <= 3 * MOST_TRIANGLES or index == 0:
        raise ValueError(f'a face with vertex {index} after {count} vertices')
    return index - 1 if index > 0 else count + index


def _stl(stream: BinaryIO, size: int) -> Floats:
    head = stream.read(84)
    count = int.from_bytes(head[80:84], 'little')
    if len(head) == 84 and size == 84 + _FACET.itemsize * count:
        if count > MOST_TRIANGLES:
            raise ValueError(f'{count} triangles; at most {MOST_TRIANGLES} are read')
        facets = np.frombuffer(stream.read(), _FACET)
        corners: Floats = facets['corners']
        return corners
    if not head.lstrip().startswith(b'solid'):
        raise ValueError(f'{size} bytes with the number {count} of triangles' if len(head) == 84
                         else f'{size} bytes')
    stream.seek(0)
    return _ascii_stl(stream)


def _ascii_stl(stream: BinaryIO) -> Floats:
    coordinates: list[float] = []
    kinds: list[bytes] = []
    for number, words in _lines(stream):
        kinds.append(words[0][:1] if words[0] == b'vertex' else words[0])
        if words[0] == b'vertex':
            try:
                x, y, z = words[1:]
                coordinates += float(x), float(y), float(z)
            except ValueError as error:
                raise ValueError(f'line {number}: {str(error)[:80]}') from error
        if len(kinds) > 8 * MOST_TRIANGLES:
            raise ValueError(f'more than {MOST_TRIANGLES} triangles')
    text = b' '.join(kinds)
    if not re.fullmatch(rb'(solid (facet outer v v v endloop endfacet )*endsolid ?)+', text):
        raise ValueError('facets that do not have three corners each, or an end that is missing')
    return _single(coordinates).reshape(-1, 3, 3)


def _lines(stream: BinaryIO) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the number, from 1, and the words of each line that has any."""
    for number, line in enumerate(iter(lambda: stream.readline(LONGEST_LINE + 1), b''), 1):
        if len(line) > LONGEST_LINE:
            raise ValueError(f'line {number}: more than {LONGEST_LINE} bytes')
        words = line.split()
        if words:
            yield number, words


def _single(numbers: list[float]) -> Floats:
    """Return coordinates as (n, 3) points, in single precision as Bullet's own reader does."""
    with np.errstate(over='ignore'):
        return np.array(numbers, dtype=np.float32).astype(float).reshape(-1, 3)
