# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Unfinished: what `fit` keeps in its output folder until the result is there, so that it can go on."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any, Callable, Mapping, Self

import numpy as np

from dlo_calibration.calibration.declaration import MACHINE
from dlo_calibration.calibration.identity import calibration_digest
from dlo_calibration.calibration.options import names_of, Options
from dlo_calibration.cli.options import given_options, PREFIX
from dlo_calibration.cli.source import left_out, Source
from dlo_calibration.errors import InputError, unwritable
from dlo_calibration.evaluation.log import CALIBRATION, Entry, EvaluationLog
from dlo_calibration.writing import reason

FOLDER, LOG = 'unfinished', 'evaluations.log'
LONGEST = 100000  # characters of a calibration's options; a stranger's must not take all memory


@dataclass(frozen=True)
class Begun:
    """
    What identifies a calibration that has begun.

    :param digest: of its trials and options.
    :param options: without those of the machine.
    :param without: numbers of the trials that are left out.
    """

    digest: str
    namespace: str | None
    options: Mapping[str, Any]
    without: tuple[int, ...] = ()


class Unfinished:
    """
    The folder ``unfinished`` in an output folder: a copy of the input, and the log of the evaluations.

    :param folder: the output folder.
    :param inputs: names that a copy of the input may have; the first one that is there is read again.
    :raises InputError: if it cannot be written, or another `fit` is using it.
    """

    def __init__(self, folder: Path, inputs: tuple[str, ...]) -> None:
        self.path = folder / FOLDER
        self._folder, self._inputs = folder, inputs
        try:
            if self.path.is_symlink():
                raise OSError('it is a link')
            self.path.mkdir(exist_ok=True)
        except OSError as error:
            raise unwritable(self.path, error, 'folder') from error
        self._new = not (self.path / LOG).exists()
        self.log = EvaluationLog(self.path / LOG)
        self._begun = _begun(self.log)

    @staticmethod
    def is_in(folder: Path) -> bool:
        """Tell whether an output folder has an unfinished calibration."""
        return (folder / FOLDER / LOG).exists()

    def complete(self, chosen: argparse.Namespace) -> None:
        """
        Complete a command line that resumes this calibration: input, namespace and options.

        :raises InputError: if nothing here can go on, or if the command line contradicts it.
        """
        begun = self._begun
        if begun is None:
            raise InputError(f'log {self.log.path}', 'no calibration', 'a log that fit has written',
                             f'use fit SESSION --output {self._folder}, with the options of the beginning')
        given, machine = given_options(chosen), names_of(MACHINE)
        for name, value in given.items():
            if name in (*machine, 'scene'):  # of a scene, the content counts, which `begin` compares
                continue
            if Options.of({name: value}).flat()[name] != begun.options[name]:
                raise InputError(f'option {name} beside --resume', f'{value}',
                                 f'{begun.options[name]}, as at the beginning',
                                 'leave it out, or begin anew with fit SESSION and another --output')
        for name, value in begun.options.items():
            # A stranger's log must not choose a file of this machine: its user names the scene again.
            if name not in given and name not in machine and name != 'scene':
                setattr(chosen, f'{PREFIX}{name}', value)
        if left_out(chosen) not in ((), begun.without):
            raise InputError('--without beside --resume', ','.join(chosen.without),
                             f'{",".join(map(str, begun.without)) or "none"}, as at the beginning',
                             'leave it out, or begin anew with fit SESSION and another --output')
        chosen.without = [str(number) for number in begun.without]
        chosen.namespace = chosen.namespace or begun.namespace
        if chosen.session is None:
            chosen.remap = []  # the copy of the input has the calibrator's names
        there = [self.path / name for name in self._inputs if (self.path / name).exists()]
        chosen.session = chosen.session or [*there, self.path / self._inputs[0]][0]

    def begin(self, source: Source, namespace: str | None, copy: Callable[[Path], None],
              note: Callable[[str], None], without: tuple[int, ...] = ()) -> EvaluationLog | None:
        """
        Keep the input of a calibration that begins or goes on; return its log.

        :param copy: writes the input into a folder.
        :param note: called with each sentence that the user should read.
        :param without: numbers of the trials that are left out.
        :returns: None if the disk refuses: the calibration is possible, but not after an interruption.
        :raises InputError: if another calibration is kept here.
        """
        begun, count = self._begun, self.log.evaluations
        digest = calibration_digest(source.trials, source.options)
        if begun is not None and begun.digest != digest:
            if count:
                raise self._other(begun, source, count)
            self.log.remove()
            self.log = EvaluationLog(self.path / LOG)
            begun = None
        if count:
            note(self.log.resumed)
        if begun is None:
            options = {name: value for name, value in source.options.flat().items()
                       if name not in names_of(MACHINE)}
            text = json.dumps({'digest': digest, 'namespace': namespace, 'options': options,
                               'without': without})
            try:
                copy(self.path)
                self.log.add(CALIBRATION, Entry(np.zeros(0), text))
            except (OSError, InputError) as error:
                note(f'warning: folder {self.path}: cannot be written: {reason(error)}; the calibration '
                     'could not go on after an interruption')
                return None
        return self.log

    def _other(self, begun: Begun, source: Source, count: int) -> InputError:
        scene = begun.options['scene']
        return InputError(
            f'folder {self._folder}', f'{count} evaluations of another calibration', 'the same trials, '
            'options and version',
            f'add --scene {scene}, which it had' if scene and not source.options.scene else
            'use fit --resume for it, choose another --output, or remove its folder unfinished')

    def remove(self) -> None:
        """Remove the folder, as the result is written."""
        for name in self._inputs:
            (self.path / name).unlink(missing_ok=True)
        self.log.remove()
        with suppress(OSError):  # somebody else's files are in it
            self.path.rmdir()

    def __enter__(self) -> Self:
        """Return it itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the log; remove the folder if it is new and without an evaluation, or has no log."""
        if not self.log.evaluations and (self._new or not self.log.path.exists()):
            self.remove()
        self.log.close()


def _begun(log: EvaluationLog) -> Begun | None:
    """Return the calibration to which a log belongs; None if it does not say so."""
    entry = log.find(CALIBRATION)
    if entry is None or len(entry.text) > LONGEST:
        return None
    try:
        begun = Begun(**json.loads(entry.text))
        return Begun(str(begun.digest), begun.namespace and str(begun.namespace),
                     Options.of(begun.options).flat(), tuple(int(number) for number in begun.without))
    except (ValueError, TypeError, AttributeError, RecursionError, InputError):  # a stranger's
        return None
