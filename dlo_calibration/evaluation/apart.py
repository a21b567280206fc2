# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""SimulatorApart: a simulator in a process of its own, so that a crash of native code ends nothing else."""

from __future__ import annotations

import pickle
from typing import Any, Callable, Mapping
import uuid

from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.evaluation.processes import ANSWER_LIMIT, ProcessEnded, ProcessExecutor
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Rollout, Simulator


class SimulatorApart:
    """
    A simulator whose calls are executed in one other process, which starts with the first call.

    Pickled, it becomes the simulator itself: what unpickles it is another process already.

    :param simulator: with what it needs read and checked, as it is pickled.
    :param content: what may crash it, in words, e.g. ``scene cell.urdf``.
    :param answer_limit: see `ProcessExecutor` [s].
    """

    def __init__(self, simulator: Simulator, content: str, answer_limit: float = ANSWER_LIMIT) -> None:
        self.name = simulator.name
        self._simulator = simulator
        self._content = content
        self._answer_limit = answer_limit
        self._sent = _Once(simulator)
        self._trials: dict[int, tuple[Trial, _Once]] = {}
        self._owner = self  # whose process executes the calls
        self._executor: ProcessExecutor | None = None

    def prepare(self) -> None:
        """
        Let the simulator prepare itself in another process, which ends then: its copies are used elsewhere.

        :raises DloCalibrationError: if that crashes.
        """
        try:
            self._there(_prepare, self._sent)
        finally:
            self.close()

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Simulate a trial with physical parameters by name (SI units).

        :raises SimulationError: if the rollout diverges.
        :raises DloCalibrationError: if the simulation crashes.
        """
        _, sent = self._trials.setdefault(id(trial), (trial, _Once(trial)))
        found: Rollout = self._there(_simulate, self._sent, sent, dict(physical))
        return found

    def refined(self) -> SimulatorApart | None:
        """Return a simulator with twice the segments and half the time step, in the same process."""
        finer = self._simulator.refined()
        if finer is None:
            return None
        apart = SimulatorApart(finer, self._content, self._answer_limit)
        apart._owner = self._owner
        return apart

    def close(self) -> None:
        """End the process, unless it is that of a coarser simulator; the next call starts another."""
        self._trials.clear()
        if self._executor is not None:
            self._executor.close()
            self._executor = None

    def _there(self, call: Callable[..., Any], *args: Any) -> Any:
        owner = self._owner
        owner._executor = owner._executor or ProcessExecutor(1, answer_limit=self._answer_limit)
        try:
            return owner._executor.submit(call, *args).result()
        except ProcessEnded as error:
            raise DloCalibrationError(f'the {self._content} could not be simulated: {error}') from error

    def __copy__(self) -> SimulatorApart:
        return SimulatorApart(self._simulator, self._content, self._answer_limit)

    def __reduce__(self) -> tuple[Callable[[Simulator], Simulator], tuple[Simulator]]:
        return _itself, (self._simulator,)


class _Once:
    """Something that is pickled once, and unpickled once in each process."""

    def __init__(self, content: Simulator | Trial) -> None:
        self._content, self._packed, self._key = content, b'', uuid.uuid4().hex

    def __reduce__(self) -> tuple[Callable[[str, bytes], Any], tuple[str, bytes]]:
        self._packed = self._packed or pickle.dumps(self._content, pickle.HIGHEST_PROTOCOL)
        return _unpacked, (self._key, self._packed)


_here: dict[str, Any] = {}  # what this process has unpacked; the process ends with `SimulatorApart.close`


def _unpacked(key: str, packed: bytes) -> Any:
    if key not in _here:
        _here[key] = pickle.loads(packed)  # noqa: S301  # sent by the parent process
    return _here[key]


def _itself(simulator: Simulator) -> Simulator:
    return simulator


def _prepare(simulator: Simulator) -> None:
    simulator.prepare()


def _simulate(simulator: Simulator, trial: Trial, physical: Mapping[str, float]) -> Rollout:
    return simulator.simulate(trial, physical)
