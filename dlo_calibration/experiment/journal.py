# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Journal: keeps the outcomes of an experiment on disk, so that it can continue after an interruption."""

from __future__ import annotations

from dataclasses import asdict
from errno import EEXIST
import json
import os
from pathlib import Path
from typing import Any, Callable, Generic, Mapping, Protocol, TypeVar

from dlo_calibration.errors import InputError

Done = TypeVar('Done')


class Recorded(Protocol):
    """A task whose outcome is kept."""

    @property
    def key(self) -> str:
        """A digest of all that the outcome depends on."""

    @property
    def about(self) -> Mapping[str, Any]:
        """Plain values that tell a reader of the journal which task it is."""


class Journal(Generic[Done]):
    """
    The outcomes of an experiment, in a file with one JSON document per line.

    An incomplete line, which a killed process leaves, is ignored.

    :param of: builds an outcome, a dataclass, from its `asdict`; raises TypeError, KeyError or ValueError
        for any other values.
    :ivar failure: why an outcome could not be written; empty if all could be.
    :raises InputError: if the file cannot be read.
    """

    def __init__(self, path: Path, of: Callable[[Mapping[str, Any]], Done]) -> None:
        self._path = path
        self.failure = ''
        self._outcomes: dict[str, Done] = {}
        if path.is_symlink() or (path.exists() and not path.is_file()):  # a FIFO would block for ever
            raise self._unusable(OSError(EEXIST, 'something that is no file has this name'))
        try:
            text = path.read_text(encoding='utf-8', errors='replace') if path.exists() else ''
        except OSError as error:
            raise self._unusable(error) from error
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._outcomes.setdefault(entry['key'], of(entry['outcome']))
            except (ValueError, TypeError, KeyError):
                continue
        self._cut = bool(text) and not text.endswith('\n')

    def find(self, task: Recorded) -> Done | None:
        """Return the outcome of a task; None if it is not done."""
        return self._outcomes.get(task.key)

    def add(self, task: Recorded, outcome: Done) -> None:
        """Append an outcome; when this returns, it is on disk, or `failure` says why not."""
        plain: Any = outcome
        line = json.dumps({**task.about, 'outcome': asdict(plain), 'key': task.key})
        try:
            with self._path.open('a', encoding='utf-8') as stream:
                stream.write(('\n' if self._cut else '') + f'{line}\n')
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            self.failure, self._cut = error.strerror or str(error), True
        else:
            self._cut = False
        self._outcomes[task.key] = outcome

    def _unusable(self, error: OSError) -> InputError:
        return InputError(f'file {self._path}', error.strerror or str(error),
                          'a file that can be read and written', 'choose another folder with --output')
