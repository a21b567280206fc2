# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Engines: the table of simulators that a user can choose, by name."""

from __future__ import annotations

import functools
from importlib import import_module
import logging
from multiprocessing import parent_process
from typing import Any, Callable, cast, Mapping, Sequence

from dlo_calibration.calibration.options import AUTO, Options
from dlo_calibration.errors import InputError, printable, SimulationError
from dlo_calibration.evaluation.apart import SimulatorApart
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.kernel_cache import is_compiled, SIMULATION
from dlo_calibration.simulation.protocol import Job, Rollout, Simulator, TogetherSimulator

SimulatorFactory = Callable[[Options], Simulator]


class _Unmade:
    """
    A simulator that is made when it is first used: the process that only sends it to others loads no kernels.

    Pickled or copied, it becomes the simulator itself.

    :param make: makes it; it is pickled.
    """

    def __init__(self, name: str, make: Callable[[], Simulator]) -> None:
        self.name = name
        self._make = make
        self._made: Simulator | None = None

    @property
    def _itself(self) -> Simulator:
        self._made = self._made or self._make()
        return self._made

    def prepare(self) -> None:
        """See to it that the kernels are compiled."""
        if not is_compiled(SIMULATION):
            self._itself.prepare()

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """Simulate a trial."""
        return self._itself.simulate(trial, physical)

    def refined(self) -> Simulator:
        """Return a finer one, which is not made yet either."""
        return type(self)(self.name, functools.partial(_finer, self._make))

    def close(self) -> None:
        """Close it if it was made."""
        if self._made is not None:
            self._made.close()

    def __reduce__(self) -> tuple[Callable[[], Simulator], tuple[()]]:
        return self._make, ()


class _UnmadeTogether(_Unmade):
    """One to which several rollouts at a time are less work."""

    def simulate_together(self, jobs: Sequence[Job], between: Callable[[], None] = lambda: None
                          ) -> list[Rollout | SimulationError]:
        """Simulate each job."""
        return cast(TogetherSimulator, self._itself).simulate_together(jobs, between)


def _new(module: str, name: str, settings: Mapping[str, Any]) -> Simulator:
    made: Simulator = getattr(import_module(module), name)(**settings)
    return made


def _finer(make: Callable[[], Simulator]) -> Simulator:
    finer = make().refined()
    assert finer is not None
    return finer


def _bullet(options: Options) -> Simulator:
    if not options.scene:
        return _Unmade('bullet', functools.partial(
            _new, 'dlo_calibration.simulation.bullet', 'BulletSimulator', engine_settings(options)))
    from dlo_calibration.simulation.bullet import BulletSimulator

    simulator = BulletSimulator(**engine_settings(options), scene=options.scene)
    if parent_process() is not None:  # a worker's process is one of its own already
        return simulator
    # A scene may come from a stranger: what it does to PyBullet must not end the node or the command.
    return SimulatorApart(simulator, f'scene {options.scene}', options.answer_limit)


def _compiled(options: Options) -> Simulator:
    if options.scene:
        raise InputError('engine compiled', f'scene {options.scene}', 'no scene: it simulates only a table',
                         'use engine bullet or auto')
    return _UnmadeTogether('compiled', functools.partial(
        _new, 'dlo_calibration.simulation.compiled', 'CompiledSimulator', engine_settings(options)))


def _auto(options: Options) -> Simulator:
    """Return the compiled engine, or Bullet with a warning if there is a scene."""
    if options.scene:
        _warn_once('PyBullet simulates the evaluations, 20 to 30 times slower, because engine compiled does '
                   f'not support a scene: {options.scene}')
        return _bullet(options)
    return _compiled(options)


def engine_settings(options: Options) -> dict[str, Any]:
    """Return the constructor arguments that all engines share."""
    return {'table': options.table, 'table_height': options.table_height, 'nodes': options.nodes,
            'time_step': options.time_step, 'stable_distance': options.stable_distance,
            'stable_time': options.stable_time, 'settle_limit': options.settle_limit}


@functools.cache
def _warn_once(text: str) -> None:
    """Log a warning, once per process."""
    logging.getLogger(__name__).warning(printable(text))


#: name -> constructor, which imports its engine only when called
ENGINES: Mapping[str, Callable[[Options], Simulator]] = {
    AUTO: _auto,
    'bullet': _bullet,
    'compiled': _compiled,
}


def make_simulator(options: Options) -> Simulator:
    """
    Return the simulator that `options` name.

    :raises InputError: if the engine is not available, or cannot represent the scene.
    """
    return ENGINES[options.engine](options)
