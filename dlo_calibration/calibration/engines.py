# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Engines: the table of simulators that a user can choose, by name."""

from __future__ import annotations

import functools
import logging
from multiprocessing import parent_process
from typing import Any, Callable, Mapping

from dlo_calibration.calibration.options import AUTO, Options
from dlo_calibration.errors import InputError, printable
from dlo_calibration.evaluation.apart import SimulatorApart
from dlo_calibration.simulation.protocol import Simulator

SimulatorFactory = Callable[[Options], Simulator]


def _bullet(options: Options) -> Simulator:
    from dlo_calibration.simulation.bullet import BulletSimulator

    simulator = BulletSimulator(**engine_settings(options), scene=options.scene)
    if not options.scene or parent_process() is not None:  # a worker's process is one of its own already
        return simulator
    # A scene may come from a stranger: what it does to PyBullet must not end the node or the command.
    return SimulatorApart(simulator, f'scene {options.scene}', options.answer_limit)


def _compiled(options: Options) -> Simulator:
    if options.scene:
        raise InputError('engine compiled', f'scene {options.scene}', 'no scene: it simulates only a table',
                         'use engine bullet or auto')
    from dlo_calibration.simulation.compiled import CompiledSimulator

    return CompiledSimulator(**engine_settings(options))


def _auto(options: Options) -> Simulator:
    """Return the compiled engine, or Bullet with a warning if there is a scene."""
    if options.scene:
        _warn_once('PyBullet simulates the evaluations, about 50 times slower, because engine compiled does '
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
