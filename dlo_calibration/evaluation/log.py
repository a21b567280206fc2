# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""EvaluationLog: a file with what has been simulated, so that a killed calibration can go on."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping  # that of typing makes isinstance ten times slower
from dataclasses import dataclass, fields, is_dataclass
import fcntl
from hashlib import blake2b
import os
from pathlib import Path
import stat
from typing import Any

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array

LONGEST = 2**25  # bytes of a line: 3 million residuals; reading a line must not take all memory
MOST = 1000000  # entries; a stranger's file must not take all memory, and `evaluations` allows no more
#: Kinds of entries: an evaluation, a rollout, and the calibration to which all of them belong.
EVALUATION, ROLLOUT, CALIBRATION = 'evaluation', 'rollout', 'calibration'


@dataclass(frozen=True)
class Entry:
    """
    What an entry of a log holds.

    :param numbers: (k,) finite.
    """

    numbers: Floats
    text: str = ''


class EvaluationLog:
    """
    A file to which each finished evaluation is appended, one line each.

    A line has a key, numbers, a text and a check sum. A line that is cut or damaged is ignored, as a
    killed process or a bad disk may leave it. A line survives the end of the process, for whatever
    reason; what the operating system itself has not written yet is lost if the power fails.

    Only one process can have a log open. It is not thread-safe.

    :param path: made if it does not exist.
    :raises InputError: if it cannot be opened, is not a regular file, or is open already.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            # A link could lead to a file of somebody else; a FIFO would block.
            self._file = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
                                 | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise self._unusable(str(error)) from error
        try:
            if not stat.S_ISREG(os.fstat(self._file).st_mode):
                raise self._unusable('no regular file')
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._places: dict[str, tuple[int, int]] = {}  # key -> first byte of its line, number of bytes
            self._cut = False  # whether the file ends within a line
            self._read()
        except BlockingIOError as error:
            os.close(self._file)
            raise InputError(f'log {self.path}', 'a log that another calibration is using', 'one at a time',
                             'wait until that calibration has ended') from error
        except OSError as error:
            os.close(self._file)
            raise self._unusable(str(error)) from error
        except BaseException:
            os.close(self._file)
            raise

    @property
    def evaluations(self) -> int:
        """Number of evaluations in it."""
        return sum(key.startswith(EVALUATION) for key in self._places)

    @property
    def resumed(self) -> str:
        """A sentence for the user of a calibration that goes on with it; empty if it holds no evaluation."""
        count = self.evaluations
        return f'goes on after {count} evaluations of an interrupted calibration' if count else ''

    def find(self, key: str) -> Entry | None:
        """
        Return the entry with a key; None if there is none, or its line is damaged.

        :raises OSError: if it cannot be read.
        """
        if key not in self._places:
            return None
        place, count = self._places[key]
        found = _parsed(os.pread(self._file, count, place))
        return found[1] if found is not None and found[0] == key else None

    def add(self, key: str, entry: Entry) -> None:
        """
        Append an entry; when this returns, it survives the end of the process.

        :param key: a word that begins with the kind.
        :raises OSError: if it cannot be written; the entries before it remain.
        """
        line = _line(key, entry)
        if key in self._places or len(line) > LONGEST:
            return
        left = memoryview(b'\n' * self._cut + line)
        self._cut = True  # until the whole line is written
        while left:
            left = left[os.write(self._file, left):]
        self._cut = False
        self._places[key] = os.lseek(self._file, 0, os.SEEK_CUR) - len(line), len(line)

    def close(self) -> None:
        """Close the file; closing twice does nothing."""
        if self._file >= 0:
            file, self._file = self._file, -1
            os.close(file)

    def remove(self) -> None:
        """Remove the file, which is no longer needed once the result is written."""
        self.path.unlink(missing_ok=True)
        self.close()
        self._places.clear()

    def __enter__(self) -> EvaluationLog:
        """Return the log itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _read(self) -> None:
        """Find the place of each whole line."""
        with open(self._file, 'rb', closefd=False) as stream:
            place = 0
            while line := stream.readline(LONGEST):
                self._cut = not line.endswith(b'\n')
                found = _parsed(line)
                if found is not None and len(self._places) < MOST:
                    self._places[found[0]] = place, len(line)
                place += len(line)
        os.lseek(self._file, 0, os.SEEK_END)

    def _unusable(self, came: str) -> InputError:
        return InputError(f'log {self.path}', came, 'a file that can be read and written',
                          'choose another folder, or remove that file')


def _line(key: str, entry: Entry) -> bytes:
    """Return the line of an entry: key, numbers, text and check sum."""
    numbers = base64.b64encode(np.ascontiguousarray(entry.numbers, '<f8').data)
    body = b' '.join((key.encode(), numbers, base64.b64encode(entry.text.encode('utf-8', 'surrogatepass'))))
    return body + b' ' + _check_sum(body) + b'\n'


def _parsed(line: bytes) -> tuple[str, Entry] | None:
    """Return key and entry of a line; None where it is cut or damaged."""
    body, _, check_sum = line.rpartition(b' ')
    if check_sum != _check_sum(body) + b'\n' or body.count(b' ') != 2:
        return None
    key, numbers, text = body.split(b' ')
    try:
        values = frozen_array(np.frombuffer(base64.b64decode(numbers, validate=True), '<f8'))
        entry = Entry(values, base64.b64decode(text, validate=True).decode('utf-8', 'surrogatepass'))
        return (key.decode(), entry) if np.isfinite(values).all() else None
    except (binascii.Error, ValueError):  # a stranger's line, as the check sum is right
        return None


def _check_sum(body: bytes) -> bytes:
    return blake2b(body, digest_size=8).hexdigest().encode()


def digest(*things: Any) -> str:
    """
    Return a digest of values, arrays and dataclasses that is the same in any process and on any machine.

    :raises TypeError: for a thing of another type.
    """
    state = blake2b(digest_size=16)
    _feed(state, things)
    return state.hexdigest()


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
