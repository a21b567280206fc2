# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Engines: the table of the simulators that a user can choose by name."""

from __future__ import annotations

import functools
from importlib.util import find_spec
from typing import Any, Callable, Mapping

from dlo_calibration.calibration.options import AUTO, Options
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.digest import code_digest, digest
from dlo_calibration.evaluation.process_simulator import bullet_simulator, ProcessSimulator
from dlo_calibration.simulation.protocol import Simulator
from dlo_calibration.simulation.scene import Obstacle, read_scene

#: Rooms whose code determines an evaluation: with another version of them, it may differ.
DECISIVE = ('model', 'observation', 'simulation', 'evaluation')

SimulatorFactory = Callable[[Options], Simulator]


class NoPyBullet(InputError):
    """PyBullet is needed, but not installed."""


def _bullet(options: Options) -> Simulator:
    content = f'scene {options.scene}' if options.scene else 'trials'
    if find_spec('pybullet') is None:
        raise NoPyBullet('engine bullet', 'no PyBullet', 'that library', 'install it: pip install pybullet')
    make = functools.partial(bullet_simulator, engine_settings(options), obstacles_of(options))
    return ProcessSimulator('bullet', make, content, options.answer_limit)


def _compiled(options: Options) -> Simulator:
    from dlo_calibration.simulation.compiled import CompiledSimulator

    return CompiledSimulator(obstacles=obstacles_of(options), **engine_settings(options))


def obstacles_of(options: Options) -> tuple[Obstacle, ...]:
    """
    Return the obstacles of the option `scene`; none if it is empty.

    :raises InputError: if the scene cannot be read.
    """
    return read_scene(options.scene) if options.scene else ()


def engine_settings(options: Options) -> dict[str, Any]:
    """Return the constructor arguments that all engines share."""
    return {'table': options.table, 'table_height': options.table_height, 'nodes': options.nodes,
            'time_step': options.time_step, 'stable_distance': options.stable_distance,
            'stable_time': options.stable_time, 'settle_limit': options.settle_limit}


def engine_digest(options: Options) -> str:
    """
    Return a digest of all that determines an evaluation besides trials and parameters: settings, scene, code.

    :raises InputError: if the scene cannot be read.
    """
    return digest(engine_settings(options), obstacles_of(options), code_digest(DECISIVE))


#: name -> constructor, which imports its engine only when called
ENGINES: Mapping[str, Callable[[Options], Simulator]] = {
    AUTO: _compiled,
    'bullet': _bullet,
    'compiled': _compiled,
}


def make_simulator(options: Options) -> Simulator:
    """
    Return the simulator that `options` name.

    :raises InputError: if the engine is not available, or cannot represent the scene.
    """
    return ENGINES[options.engine](options)
