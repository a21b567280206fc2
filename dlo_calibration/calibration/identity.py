# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Identity: digests that tell whether evaluations and calibrations are the same."""

from __future__ import annotations

from pathlib import Path
from typing import Sequence

from dlo_calibration.calibration.automatic import choose
from dlo_calibration.calibration.declaration import MACHINE
from dlo_calibration.calibration.engines import engine_settings
from dlo_calibration.calibration.options import names_of, Options
from dlo_calibration.evaluation.log import digest
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.core import _core

#: Rooms whose code decides what an evaluation gives: another version of them may give something else.
DECISIVE = ('model', 'observation', 'simulation', 'evaluation')


def engine_digest(options: Options) -> str:
    """
    Return a digest of all that decides an evaluation, besides trials and parameters: settings, scene, code.

    :raises InputError: if the scene cannot be read.
    """
    return digest(engine_settings(options), _scene(options.scene), _code())


def calibration_digest(trials: Sequence[Trial], options: Options) -> str:
    """
    Return a digest that two calibrations share if they have the same evaluations in the same order.

    :raises InputError: if the scene cannot be read.
    """
    without = {*names_of(MACHINE), 'scene'}  # the content of the scene counts, not its path
    chosen = {name: value for name, value in choose(trials, options).options.flat().items()
              if name not in without}
    return digest(engine_digest(options), chosen, tuple(trials))


def _scene(path: str) -> tuple[object, ...]:
    if not path:
        return ()
    from dlo_calibration.simulation.obstacles import read_scene

    return read_scene(path)


def _code() -> str:
    package = Path(__file__).parents[1]
    files = [file for room in DECISIVE for file in sorted((package / room).glob('*.py'))]
    return digest(*(file.read_bytes() for file in (*files, Path(_core.__file__))))
