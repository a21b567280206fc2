# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
ProcessSimulator: a simulator in a process of its own, which may crash or hang without harm.

PyBullet needs this: it never releases Python's lock, and a stranger's scene may crash it.  A
ProcessPoolExecutor is unusable once a process has died, and can neither stop a call nor replace a process
that hangs.  pebble limits the time of a whole call, but a long rollout that makes progress must go on: the
heartbeat here measures only the time in which native code does not return.
"""

from __future__ import annotations

from concurrent.futures import CancelledError
import faulthandler
from functools import partial
import logging
from multiprocessing.connection import Connection, Pipe
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time
from typing import Any, Callable, Mapping, NoReturn, Sequence

from dlo_calibration.errors import DloCalibrationError, SimulationError
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Job, Rollout, Simulator, Stop, TogetherSimulator
from dlo_calibration.simulation.scene import Obstacle

DEATHS = 3  # processes that may end at the same rollout before it fails
HANGING = 1  # exit code of `faulthandler`
PERIOD = 0.05  # s between two polls of the stop flag
MOST_TRIALS = 1000  # in a process
NICE = 5  # by which the priority of a process is lower: the parent, which answers users, comes first
PROGRAM = ('import os, sys; os.nice({nice}); sys.path[:] = {path}; from {module} import work; '
           'work({number}, {limit})')


class ProcessSimulator(TogetherSimulator):
    """
    A simulator in a process of its own; threads that call it at the same time have one process each.

    The processes start with the first rollouts.  They end by `close`, or when this process ends or is killed.

    :param name: of the simulator.
    :param make: makes the simulator in the process; picklable.
    :param content: what is simulated, for warnings and errors, e.g. ``scene cell.urdf``.
    :param answer_limit: time [s] without an answer of native code after which a process is replaced.
    :param finer: number of times that the simulator is refined.
    """

    at_a_time = 1

    def __init__(self, name: str, make: Callable[[], Simulator], content: str, answer_limit: float,
                 finer: int = 0) -> None:
        self.name = name
        self._make, self._content, self._answer_limit, self._finer = make, content, answer_limit, finer
        self._idle: list[_Process] = []

    def start(self) -> None:
        """Start a process now, so that it loads the simulator in the background."""
        self._idle.append(self._process())

    def simulate_together(self, jobs: Sequence[Job], stop: Stop) -> list[Rollout | SimulationError]:
        """
        Simulate one job after the other; see `TogetherSimulator`.

        :raises DloCalibrationError: if a process ends unexpectedly `DEATHS` times at the same job.
        """
        return [self._simulated(job, stop) for job in jobs]

    def refined(self) -> ProcessSimulator:
        """Return a simulator with twice the segments and half the time step."""
        return ProcessSimulator(self.name, self._make, self._content, self._answer_limit, self._finer + 1)

    def close(self) -> None:
        """End the idle processes; the next call starts another."""
        while self._idle:
            self._idle.pop().end()

    def _process(self) -> _Process:
        return _Process(self._make, self._finer, self._answer_limit)

    def _simulated(self, job: Job, stop: Stop) -> Rollout | SimulationError:
        for _ in range(DEATHS):
            try:
                process = self._idle.pop()
            except IndexError:
                process = self._process()
            try:
                outcome = process.simulated(job, stop)
            except (EOFError, OSError):
                ending, remedy = self._ending(process.end(patience=10.0), time.monotonic() - process.asked)
                logging.getLogger(__name__).warning(
                    'a process that simulates the %s %s; its rollout is repeated', self._content, ending)
            except BaseException:
                process.end()
                raise
            else:
                self._idle.append(process)
                if isinstance(outcome, (Rollout, SimulationError)):
                    return outcome
                raise outcome
        raise DloCalibrationError(
            f'the {self._content} could not be simulated: {DEATHS} processes one after the other ended '
            f'unexpectedly at the same evaluation, the last one {ending}; {remedy}')

    def _ending(self, code: int, silence: float) -> tuple[str, str]:
        """Return how a process ended and what to do about it, in words."""
        remedy = 'free memory, or use fewer workers'
        if code == HANGING and silence >= self._answer_limit:
            return f'gave no answer for {self._answer_limit:g} s and is replaced', 'raise answer_limit'
        if code >= 0:
            return f'ended unexpectedly with exit code {code}', remedy
        killed = f'was killed by {signal.Signals(-code).name}'
        if code == -signal.SIGKILL:
            return f'{killed}, as happens when memory runs out', remedy
        return killed, f'{remedy}, or simulate without a scene'

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the processes, which are children of this process."""
        return {**self.__dict__, '_idle': []}


class _Process:
    """A process that simulates, and the trials that it has received."""

    def __init__(self, make: Callable[[], Simulator], finer: int, answer_limit: float) -> None:
        self._channel, there = Pipe()
        # Leave out the working directory (''): a file there may have the name of a module.
        path = [*filter(None, sys.path), str(Path(__file__).parents[2])]
        program = PROGRAM.format(
            nice=NICE, path=path, module=__name__, number=there.fileno(), limit=answer_limit)
        try:
            self._process = subprocess.Popen(
                [sys.executable, '-S', '-c', program], pass_fds=[there.fileno()], process_group=0,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                env={**os.environ, 'OPENBLAS_NUM_THREADS': '1'})  # others would spin for 50 ms
        except OSError as error:
            raise DloCalibrationError(f'a process that simulates could not be started ({error}); '
                                      'use fewer workers') from error
        finally:
            there.close()
        self._sent: dict[int, tuple[Trial, int]] = {}
        self.asked = time.monotonic()  # [s] when the last job was sent
        self._channel.send((make, finer))

    def simulated(self, job: Job, stop: Stop) -> Any:
        """
        Return the rollout of a job, or the error that the job raised in the process.

        :raises EOFError, OSError: if the process ends.
        :raises CancelledError: as soon as `stop` is set.
        """
        trial, physical = job
        if len(self._sent) == MOST_TRIALS:
            self._sent.clear()
        is_new = id(trial) not in self._sent
        _, number = self._sent.setdefault(id(trial), (trial, len(self._sent)))
        self.asked = time.monotonic()
        self._channel.send((number, trial if is_new else None, dict(physical)))
        while not self._channel.poll(PERIOD):
            if stop.is_set():
                raise CancelledError
        return self._channel.recv()

    def end(self, patience: float = 0.0) -> int:
        """Return the exit code of the process, which is killed if it does not end within `patience` [s]."""
        self._channel.close()
        try:
            return self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


def bullet_simulator(settings: Mapping[str, Any], obstacles: Sequence[Obstacle]) -> Simulator:
    """Return the engine in PyBullet; only the process that simulates imports it."""
    from dlo_calibration.simulation.bullet import BulletSimulator

    return BulletSimulator(obstacles=obstacles, **settings)


def work(number: int, answer_limit: float) -> None:
    """Simulate until the parent closes the connection; the main function of a process."""
    nowhere = open(os.devnull, 'w')
    end_later = partial(faulthandler.dump_traceback_later, answer_limit, exit=True, file=nowhere)
    end_later()  # before anything can hang
    threading.Thread(target=_watch, args=(end_later, min(0.25, answer_limit / 4), os.getppid()),
                     daemon=True).start()
    channel = Connection(number)
    try:
        make, finer = channel.recv()
        failure: Exception | None = None
        try:
            simulator = make()
            for _ in range(finer):
                simulator = simulator.refined() or simulator
        except Exception as error:  # each rollout raises it
            failure = error
        trials: dict[int, Trial] = {}
        while True:
            place, trial, physical = channel.recv()
            if trial is not None:
                trials[place] = trial
            try:
                if failure is not None:
                    raise failure
                answer: Any = simulator.simulate(trials[place], physical)
            except Exception as error:
                answer = error
            try:
                channel.send(answer)
            except (TypeError, AttributeError):  # an error that cannot be pickled
                channel.send(RuntimeError(f'{type(answer).__name__}: {answer}'))
    except (EOFError, OSError):  # the parent has closed the connection, or has ended
        os._exit(0)


def _watch(end_later: Callable[[], None], period: float, parent: int) -> NoReturn:
    """
    Heartbeat: every `period` [s], postpone the end of the process, until its parent has ended.

    Native code that hangs holds Python's lock, so that this thread can no longer postpone it.
    """
    while os.getppid() == parent:
        end_later()
        time.sleep(period)
    os._exit(0)
