# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plot: the files of pictures and animations of a session, one for each trial."""

from __future__ import annotations

from pathlib import Path
from typing import Callable, Mapping, Sequence

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.report.animation import simulated_motion, write_animation
from dlo_calibration.report.drawing import trial_picture, unwritable
from dlo_calibration.simulation.protocol import Simulator


def write_pictures(trials: Sequence[Trial], chains: Sequence[Floats] | None, folder: Path,
                   note: Callable[[str], None]) -> list[Path]:
    """
    Write ``trial_1.png``, ``trial_2.png``, ... into a folder, which is made.

    :param chains: of each trial, (g, n, 3) [m] simulated at its goals; None: observed only.
    :param note: called with the path of each file, once it is written.
    :raises InputError: where a file cannot be written.
    """
    paths = _paths(trials, folder, '.png')
    for k, (trial, path) in enumerate(zip(trials, paths, strict=True)):
        trial_picture(trial, None if chains is None else chains[k], path)
        note(str(path))
    return paths


def write_animations(trials: Sequence[Trial], simulator: Simulator, physical: Mapping[str, float],
                     folder: Path, note: Callable[[str], None]) -> list[Path]:
    """
    Simulate trials and write ``trial_1.gif``, ``trial_2.gif``, ... into a folder, which is made.

    :param physical: parameters by name (SI units).
    :param note: called with the path of each file, once it is written.
    :raises InputError: where a file cannot be written.
    :raises SimulationError: where a trial cannot be simulated.
    """
    paths = _paths(trials, folder, '.gif')
    for trial, path in zip(trials, paths, strict=True):
        write_animation(trial, simulated_motion(trial, simulator, physical), path)
        note(str(path))
    return paths


def _paths(trials: Sequence[Trial], folder: Path, suffix: str) -> list[Path]:
    """Name the files by number: the name of a trial may be anything."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from error
    return [folder / f'trial_{k}{suffix}' for k in range(1, len(trials) + 1)]
