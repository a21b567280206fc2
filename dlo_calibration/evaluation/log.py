# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
EvaluationLog: a file with all results of simulations; Memory: finds these, so that none is repeated.

A calibration that was killed resumes from its log.
"""

from __future__ import annotations

import base64
import binascii
from contextlib import suppress
from dataclasses import astuple, dataclass, fields, replace
import fcntl
from hashlib import blake2b
import os
from pathlib import Path
import stat
import threading
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.digest import digest
from dlo_calibration.evaluation.evaluation import Evaluation, Evaluator
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.score import PointErrors
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.protocol import Job, Rollout

LONGEST = 2**25  # bytes of a line: 3 million residuals; a stranger's line must not take all memory
MOST = 1000000  # entries; a stranger's file must not take all memory, and `evaluations` allows no more
#: Kinds of entries: an evaluation, a rollout, and the calibration to which these belong.
EVALUATION, ROLLOUT, CALIBRATION = 'evaluation', 'rollout', 'calibration'
ERRORS = len(fields(PointErrors))


@dataclass(frozen=True)
class Entry:
    """
    The content of an entry of a log.

    :param numbers: (k,) finite.
    """

    numbers: Floats
    text: str = ''


class EvaluationLog:
    """
    A file to which each finished evaluation is appended, one line each.

    A line has a key, numbers, a text and a check sum. A cut or damaged line, e.g. of a killed process or a
    bad disk, is ignored. A written line survives any end of the process, but not a power failure before the
    operating system has written it to disk.

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
        except BaseException as error:
            os.close(self._file)
            if isinstance(error, BlockingIOError):
                raise InputError(f'log {self.path}', 'a log that another calibration is using',
                                 'one at a time', 'wait until that calibration has ended') from error
            if isinstance(error, OSError):
                raise self._unusable(str(error)) from error
            raise

    @property
    def evaluations(self) -> int:
        """Number of evaluations in it."""
        return sum(key.startswith(EVALUATION) for key in self._places)

    @property
    def resumed(self) -> str:
        """A notice for the user of a calibration that resumes with this log; '' if it has no evaluation."""
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
        line = _parsed(os.pread(self._file, count, place))
        return line[1] if line is not None and line[0] == key else None

    def add(self, key: str, entry: Entry) -> None:
        """
        Append an entry; when this returns, it survives the end of the process.

        :param key: a word that begins with the kind.
        :raises OSError: if it cannot be written; the entries before it remain.
        """
        line = _line(key, entry)
        if key in self._places or len(line) > LONGEST:
            return
        remaining = memoryview(b'\n' * self._cut + line)
        self._cut = True  # until the whole line is written
        while remaining:
            remaining = remaining[os.write(self._file, remaining):]
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
        """Store the place of each whole line."""
        with open(self._file, 'rb', closefd=False) as stream:
            place = 0
            while line := stream.readline(LONGEST):
                self._cut = not line.endswith(b'\n')
                parsed = _parsed(line)
                if parsed is not None and len(self._places) < MOST:
                    self._places[parsed[0]] = place, len(line)
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
    """Return key and entry of a line; None if it is cut or damaged."""
    body, _, check_sum = line.rpartition(b' ')
    if check_sum != _check_sum(body) + b'\n' or body.count(b' ') != 2:
        return None
    key, numbers, text = body.split(b' ')
    try:
        values = frozen_array(np.frombuffer(base64.b64decode(numbers, validate=True), '<f8'))
        entry = Entry(values, base64.b64decode(text, validate=True).decode('utf-8', 'surrogatepass'))
        return (key.decode(), entry) if np.isfinite(values).all() else None
    except (binascii.Error, ValueError):  # a stranger's line, since its check sum is right
        return None


def _check_sum(body: bytes) -> bytes:
    return blake2b(body, digest_size=8).hexdigest().encode()


class Memory:
    """
    The results in the log of a calibration; new results are added.

    :param log: None: nothing is stored.
    :param engine: digest of the engine's settings.
    :param on_failure: called once, with a warning, if the log can no longer be written.
    """

    def __init__(self, log: EvaluationLog | None = None, engine: str = '',
                 on_failure: Callable[[str], None] = lambda _: None) -> None:
        self._log, self._engine, self._on_failure = log, engine, on_failure
        self._full = False
        self._writing = threading.Lock()  # threads that simulate also write
        self._digests: dict[int, tuple[Trial | Goal, str]] = {}

    def of(self, evaluator: Evaluator, finer: bool = False) -> EvaluatorMemory:
        """
        Return the memory of an evaluator's points.

        :param finer: whether its simulator is the engine's refined one.
        """
        base = '' if self._log is None else digest(
            self._engine, evaluator.simulator.name, finer, [self.digest(trial) for trial in evaluator.trials],
            evaluator.space, evaluator.layout)
        return EvaluatorMemory(self, base, evaluator)

    def rollout(self, simulator: str, job: Job) -> Rollout | SimulationError | None:
        """Return the rollout of a job by a simulator of this name, or why it failed; None if not stored."""
        entry = None if self._log is None else self.find(self._key(simulator, job))
        if entry is None:
            return None
        goals, points, numbers = len(job[0].goals), len(job[0].initial), entry.numbers
        if not len(numbers):
            return SimulationError(entry.text)
        end = 2 + goals + 3 * goals * points
        if len(numbers) != end + 3 * len(job[0].forces):  # a stranger's entry
            return None
        settled = tuple(bool(flag) for flag in numbers[2:2 + goals])
        return Rollout(np.reshape(numbers[2 + goals:end], (goals, points, 3)), settled, float(numbers[0]),
                       int(numbers[1]), forces=np.reshape(numbers[end:], (-1, 3)))

    def add_rollouts(self, simulator: str, jobs: Sequence[Job], rollouts: list[Rollout | SimulationError]
                     ) -> list[Rollout | SimulationError]:
        """Store the rollouts of jobs, and return them."""
        if self._log is not None:
            for job, rollout in zip(jobs, rollouts, strict=True):
                entry = Entry(np.zeros(0), str(rollout)) if isinstance(rollout, SimulationError) else Entry(
                    np.array([rollout.duration, rollout.steps, *rollout.settled, *rollout.chains.ravel(),
                              *rollout.forces.ravel()]))
                self.add(self._key(simulator, job), entry)
        return rollouts

    def _key(self, simulator: str, job: Job) -> str:
        return f'{ROLLOUT}-{digest(self._engine, simulator, self.digest(job[0]), job[1])}'

    def digest(self, trial: Trial) -> str:
        """Return the digest of a trial; cached with those of its goals, as trials may share hundreds."""
        if id(trial) not in self._digests:
            others = {field.name: getattr(trial, field.name) for field in fields(trial)
                      if field.name != 'goals'}
            self._digests[id(trial)] = trial, digest(others, [self._goal(goal) for goal in trial.goals])
        return self._digests[id(trial)][1]

    def _goal(self, goal: Goal) -> str:
        if id(goal) not in self._digests:
            self._digests[id(goal)] = goal, digest(goal)  # with the goal, so that no other goal gets its id
        return self._digests[id(goal)][1]

    def find(self, key: str) -> Entry | None:
        """Return the entry with a key; None if there is none."""
        with suppress(OSError):  # an unreadable entry is simulated again
            return None if self._log is None else self._log.find(key)
        return None

    def add(self, key: str, entry: Entry) -> None:
        """Write an entry, unless an earlier entry could not be written."""
        with self._writing:
            if self._log is None or self._full:
                return
            try:
                self._log.add(key, entry)
            except OSError as error:
                self._full = True
                self._on_failure(f'log {self._log.path}: cannot be written: {error}; the calibration goes '
                                 'on, but if it is interrupted, the evaluations from here on are lost')


class EvaluatorMemory:
    """
    The stored evaluations of one evaluator.

    :param base: digest of what an evaluation depends on, except the point; empty: nothing is stored.
    """

    def __init__(self, memory: Memory, base: str, evaluator: Evaluator) -> None:
        self._memory, self._base = memory, base
        self._trials, self._space = evaluator.trials, evaluator.space
        self._size = evaluator.layout.rows[-1].stop

    def find(self, index: int, point: Floats) -> Evaluation | None:
        """Return the evaluation of a (d,) point of the box; None if there is none."""
        entry = self._memory.find(self._key(point)) if self._base else None
        if entry is None:
            return None
        count, numbers = len(self._trials), entry.numbers
        evaluation = Evaluation(index, frozen_array(point), self._space.values(point))
        if len(numbers) == 1 and numbers[0] in range(count):
            return replace(evaluation, failure=entry.text, skipped=int(numbers[0]))
        if len(numbers) != 2 * count + ERRORS + self._size:  # a stranger's entry
            return None
        unsettled, scores, errors, residuals = np.split(numbers, np.cumsum([count, count, ERRORS]))
        return replace(
            evaluation, scores=tuple(scores.tolist()), errors=PointErrors(*errors.tolist()),
            residuals=frozen_array(residuals),
            unsettled=tuple(trial.name for trial, flag in zip(self._trials, unsettled, strict=True) if flag))

    def add(self, evaluation: Evaluation) -> None:
        """Store a finished evaluation."""
        if not self._base:
            return
        if evaluation.residuals is None or evaluation.errors is None:
            entry = Entry(np.array([float(evaluation.skipped)]), evaluation.failure)
        else:
            entry = Entry(np.concatenate([
                _flags(self._trials, evaluation.unsettled), evaluation.scores, astuple(evaluation.errors),
                evaluation.residuals]))
        self._memory.add(self._key(evaluation.point), entry)

    def _key(self, point: Floats) -> str:
        return f'{EVALUATION}-{digest(self._base, np.asarray(point, float))}'


def _flags(trials: Sequence[Trial], names: Sequence[str]) -> list[float]:
    """Return 1 for each trial in `names`, which have the order of the trials, and 0 for the others."""
    flags, remaining = [], list(names)
    for trial in trials:
        flags.append(float(remaining[:1] == [trial.name]))
        remaining = remaining[int(flags[-1]):]
    return flags
