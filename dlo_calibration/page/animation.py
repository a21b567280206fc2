# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Animation: the simulated motion of a trial, drawn over a photograph."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.files.result import Description
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.motion import Motion, simulated_motion
from dlo_calibration.vision.scale import Scale

PAUSE = 0.5  # s in the animation between the last simulated instant and the DLO at rest


def animated_motion(trial: Trial, description: Description, make_simulator: SimulatorFactory) -> Motion:
    """
    Simulate a trial with the parameters of a result; the last chain is compared with the goal.

    :raises DloCalibrationError: if it cannot be simulated.
    """
    options = Options.of(description.file_options.values)
    with closing(make_simulator(options)) as simulator:
        motion = simulated_motion(trial, simulator, description.physical())
    return Motion(np.append(motion.times, motion.times[-1] + PAUSE),
                  np.concatenate([motion.chains, motion.ends[-1:]]), motion.ends)


def animated(trial: Trial, motion: Motion, scale: Scale) -> dict[str, Any]:
    """
    Return a motion as the page shows it over a photograph.

    :returns: `times` [s]; `pixels`: of the chain, at each time; `goal`: index of the time that is compared
        with the goal; `names`: of the hands; `hands`: the pixel at which each holds the DLO, at each time.
    """
    names = list(dict.fromkeys(hand.name for hand in trial.hands))
    shown = scale.to_pixels(motion.chains.reshape(-1, 3)).reshape(*motion.chains.shape[:2], 2)
    return {'times': np.round(motion.times, 4).tolist(), 'pixels': _rounded(shown),
            'goal': len(motion.times) - 1, 'names': names,
            'hands': [_holding(trial, names, float(time), scale) for time in motion.times]}


def _holding(trial: Trial, names: list[str], time: float, scale: Scale) -> list[list[float] | None]:
    """Return the pixel of each hand that holds the DLO at a time; None for each other hand."""
    following = next((goal for goal in trial.goals if goal.time >= time), trial.goals[-1])
    holding = {hand.name: hand for hand in trial.holding(
        Goal(trial.initial, time, stable=False, held_by=following.held_by))}
    return [_rounded(scale.to_pixels(holding[name].positions_at(np.array([time]))))[0] if name in holding
            else None for name in names]


def _rounded(pixels: Floats) -> Any:
    """Return pixels as lists, rounded to a tenth: a screen shows no more."""
    return np.round(pixels, 1).tolist()
