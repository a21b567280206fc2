# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Journal: keeps the outcomes of an experiment on disk, so that it can continue after an interruption."""

from __future__ import annotations

from dataclasses import asdict
from errno import EEXIST
import json
import os
from pathlib import Path

from dlo_calibration.errors import InputError
from dlo_calibration.experiment.outcome import Outcome
from dlo_calibration.experiment.study import Task


class Journal:
    """
    The outcomes of an experiment, in a file with one JSON document per line.

    An incomplete line, which a killed process leaves, is ignored.

    :ivar failure: why an outcome could not be written; empty if all could be.
    :raises InputError: if the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.failure = ''
        self._outcomes: dict[str, Outcome] = {}
        if path.is_symlink() or (path.exists() and not path.is_file()):  # a FIFO would block for ever
            raise self._unusable(OSError(EEXIST, 'something that is no file has this name'))
        try:
            text = path.read_text(encoding='utf-8', errors='replace') if path.exists() else ''
        except OSError as error:
            raise self._unusable(error) from error
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._outcomes.setdefault(entry['key'], Outcome.of(entry['outcome']))
            except (ValueError, TypeError, KeyError):
                continue
        self._cut = bool(text) and not text.endswith('\n')

    def find(self, task: Task) -> Outcome | None:
        """Return the outcome of a task; None if it is not done."""
        return self._outcomes.get(task.key)

    def add(self, task: Task, outcome: Outcome) -> None:
        """Append an outcome; when this returns, it is on disk, or `failure` says why not."""
        line = json.dumps({
            'object': task.subject.name, 'search': task.search, 'seed': task.seed, 'engine': task.engine,
            'left_out': None if task.left_out is None else task.left_out + 1,
            'outcome': asdict(outcome), 'key': task.key})
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
