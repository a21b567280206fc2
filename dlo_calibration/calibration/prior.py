# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The prior of a calibration: what the observed chains alone say of its parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace, SCALE
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.estimate import start_point
from dlo_calibration.observation.excitation import excites
from dlo_calibration.search import Hints

#: The height at which the DLO lies tells this radius; no other parameter has a guess where no trial shows it.
GUESSED = 'self_collision'


@dataclass(frozen=True)
class Prior:
    """
    What is known before anything is simulated.

    :param space: the parameters to find; defaults that the chains contradict are replaced by guesses.
    :param hints: for the search.
    :param guessed: names of the parameters whose default is such a guess.
    """

    space: ParameterSpace
    hints: Hints
    guessed: tuple[str, ...] = ()


def prior(trials: Sequence[Trial], options: Options) -> Prior:
    """Return what the observed chains alone say of the parameters that `options` ask for."""
    space = options.space
    height = options.table_height if options.table else None
    shown = np.logical_or.reduce(excites(trials, space, height))
    hints = Hints(start_point(trials, space, height), shown)
    default = BY_NAME[GUESSED].default
    if GUESSED not in space.free or space.fixed.get(GUESSED, default) != default:
        return Prior(space, hints)
    start = float(hints.start[space.free.index(GUESSED)])
    if not 0 <= start <= 1:
        return Prior(space, hints)
    return Prior(replace(space, fixed={**space.fixed, GUESSED: start * SCALE}), hints, (GUESSED,))
