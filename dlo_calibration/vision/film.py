# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Film: what a video file shows, image by image.

The file is decoded in a process of its own (`decoder`), piece by piece: a film of any length takes the memory
of some images.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
import fcntl
import math
import os
from pathlib import Path
import subprocess
import sys
from typing import Iterator, NoReturn

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.reading import require_file
from dlo_calibration.vision import decoder
from dlo_calibration.vision.photograph import MINIMUM_SIDE, Pixels

MAXIMUM_OCTETS = 2 * 2**30
SIGNATURE = 64  # octets at a file's beginning that tell what it is
PIECE = 96 * 2**20  # octets of images that are read at once to play a film backwards
PIPE = 2**20  # octets, the largest that Linux allows
EXPECTED = 'a film as an mp4, mov, webm, mkv or avi file'
_EXPORT = 'export it as mp4 with H.264, 1920 x 1080'
#: what the decoder's exit codes say: what came, and the remedy
_ENDINGS = {
    decoder.UNREADABLE: ('a film whose end is missing or that is damaged',
                         'stop the recording before the film is copied, and copy it again'),
    decoder.UNDECODABLE: ('a film without pictures that can be decoded', _EXPORT),
    decoder.TOO_LARGE: (f'pictures of more than {decoder.MAXIMUM_PIXELS / 1e6:.0f} megapixels', _EXPORT),
    decoder.CHANGED: ('pictures whose size changes', _EXPORT),
    decoder.HANGING: (f'a film that cannot be decoded within {decoder.SILENCE:.0f} s', _EXPORT),
}
PROGRAM = ('import os, sys; os.nice(2); sys.path[:] = {path!r}; '
           'from dlo_calibration.vision.decoder import main; main({film!r})')


@dataclass(frozen=True, eq=False)
class Frame:
    """
    One image of a film.

    :param time: since the film's beginning [s].
    :param pixels: (h, w, 3) red, green, blue of each pixel, 0 to 255; upright.
    """

    time: float
    pixels: Pixels


@dataclass(frozen=True)
class Film:
    """
    A film; iterating gives its frames from the beginning, again and again.

    :param size: width and height of its pictures, upright [px].
    :param duration: as the file says [s].
    :param frame_rate: mean [1/s]; the times between frames may vary.
    """

    path: Path
    size: tuple[int, int]
    duration: float
    frame_rate: float

    def __iter__(self) -> Iterator[Frame]:
        """Give all frames."""
        return self.frames()

    def frames(self, start: float = 0.0, end: float = math.inf) -> Iterator[Frame]:
        """
        Give the frames with start <= time < end [s].

        :raises InputError: where the decoder crashes or hangs.
        """
        with closing(_Decoding(self.path)) as decoding:
            yield from decoding.frames(start, end)

    def backwards(self, start: float = math.inf) -> Iterator[Frame]:
        """
        Give the frames before a time [s], the last one first.

        :raises InputError: where the decoder crashes or hangs.
        """
        width, height = self.size
        step = max(1, PIECE // (3 * width * height)) / self.frame_rate
        # The duration that a file says may be a little too short.
        begin = min(start, self.duration)
        with closing(_Decoding(self.path)) as decoding:
            yield from reversed(list(decoding.frames(begin, start)))
            while begin > 0.0:
                begin, end = max(0.0, begin - step), begin
                yield from reversed(list(decoding.frames(begin, end)))


def read_film(path: Path) -> Film:
    """
    Open a film.

    :raises InputError: where it cannot be read.
    """
    _check(path)
    with closing(_Decoding(path)) as decoding:
        if min(decoding.size) < MINIMUM_SIDE:
            raise InputError(f'film {path}', '{} x {} pixels'.format(*decoding.size),
                             f'at least {MINIMUM_SIDE} pixels a side', 'make a larger one')
        return Film(path, decoding.size, decoding.duration, decoding.frame_rate)


def _check(path: Path) -> None:
    """Refuse what is no film: FFmpeg reads other kinds of files, some of which name further ones."""
    thing = f'film {path}'
    try:
        require_file(path, thing, EXPECTED)
        size = path.stat().st_size
        with path.open('rb') as stream:
            begin = stream.read(SIGNATURE)
    except (OSError, ValueError) as error:
        raise InputError(thing, getattr(error, 'strerror', None) or str(error), EXPECTED,
                         'check the path') from error
    if not begin:
        raise InputError(thing, 'an empty file', EXPECTED, 'copy it from the camera again')
    if size > MAXIMUM_OCTETS:
        raise InputError(thing, f'{size / 1e9:.1f} GB', f'at most {MAXIMUM_OCTETS / 1e9:.1f} GB',
                         'cut it, or export it with 1920 x 1080 pixels')
    film = (begin[4:8] in (b'ftyp', b'moov', b'mdat', b'wide', b'free', b'skip', b'pnot')
            or begin.startswith(b'\x1aE\xdf\xa3') or begin[:4] == b'RIFF' and begin[8:12] == b'AVI ')
    picture = begin[8:12] in (b'avif', b'heic', b'heix', b'mif1', b'msf1') and begin[4:8] == b'ftyp'
    if picture or begin.startswith((b'\xff\xd8\xff', b'\x89PNG')):
        raise InputError(thing, 'a photograph', EXPECTED, 'name a film, or trace the photograph')
    if not film:
        raise InputError(thing, 'a file that is no film', EXPECTED, _EXPORT)


class _Decoding:
    """A process that decodes a film."""

    def __init__(self, path: Path) -> None:
        self._thing = f'film {path}'
        where = [*filter(None, sys.path), str(Path(__file__).parents[2])]
        program = PROGRAM.format(path=where, film=os.path.abspath(path))
        self._process = subprocess.Popen(
            [sys.executable, '-S', '-c', program], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, process_group=0, env={**os.environ, 'OPENBLAS_NUM_THREADS': '1'})
        assert self._process.stdin is not None and self._process.stdout is not None
        self._requests, self._answers = self._process.stdin, self._process.stdout
        try:
            fcntl.fcntl(self._answers.fileno(), fcntl.F_SETPIPE_SZ, PIPE)
        except OSError:  # then it is slower
            pass
        try:
            header = bytearray(decoder.HEADER.size)
            self._receive(header)
        except BaseException:
            self.close()
            raise
        width, height, self.frame_rate, self.duration = decoder.HEADER.unpack(header)
        self.size = width, height

    def frames(self, begin: float, end: float) -> Iterator[Frame]:
        """Give the frames with begin <= time < end [s]; all must be taken before the next call."""
        width, height = self.size
        try:
            self._requests.write(decoder.REQUEST.pack(begin, end))
            self._requests.flush()
        except OSError:
            self._fail()
        stamp = bytearray(decoder.FRAME.size)
        while True:
            self._receive(stamp)
            time, = decoder.FRAME.unpack(stamp)
            if math.isnan(time):
                return
            pixels = np.empty((height, width, 3), np.uint8)
            self._receive(pixels.data.cast('B'))
            yield Frame(time, pixels)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._requests, self._answers):
            try:
                stream.close()
            except OSError:
                pass

    def _receive(self, into: bytearray | memoryview) -> None:
        if self._answers.readinto(into) < len(into):  # type: ignore[attr-defined]
            self._fail()

    def _fail(self) -> NoReturn:
        """Raise the error that says how the process ended."""
        code = self._process.wait()
        came, remedy = _ENDINGS.get(code, ('a film at which the decoder crashes', _EXPORT))
        raise InputError(self._thing, came, EXPECTED, remedy)
