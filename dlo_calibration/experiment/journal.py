# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Journal: keeps the outcomes of an experiment on disk, so that it can continue after an interruption."""

from __future__ import annotations

from dataclasses import asdict
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

    :raises InputError: if the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._outcomes: dict[str, Outcome] = {}
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
        """
        Append an outcome; it is on disk when this returns.

        :raises InputError: if it cannot be written.
        """
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
            raise self._unusable(error) from error
        self._cut = False
        self._outcomes[task.key] = outcome

    def _unusable(self, error: OSError) -> InputError:
        return InputError(f'file {self._path}', str(error), 'a file that can be read and written',
                          'choose another folder with --output')
