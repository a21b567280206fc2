# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Automatic: the options that a user leaves open, as the trials decide them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

from dlo_calibration.calibration.options import AUTO, Options
from dlo_calibration.model.parameters import PAPER_PARAMETERS
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.excitation import motions
from dlo_calibration.search import LeastSquares

#: What `calibrate` auto adds to the paper's parameters.
IN_MOTION = ('damping', 'internal_damping')
BETWEEN_CLAMPS = ('torsion', 'bending_friction', 'bending_slip')

DECIDED = ('calibrate', 'evaluations')  # names of the options that may be open

PAPER_ROUNDS = 150  # evaluations; enough for the paper's four parameters
LINEARISATIONS = 15  # that a search can make with its budget: a Gauss-Newton descent takes about 10
REFINEMENT = 400  # evaluations for rest shape and parts, where these are open, beside those of one search


@dataclass(frozen=True)
class Choice:
    """
    What was chosen for a calibration.

    :param options: without an option that is open.
    :param words: which parameters `calibrate` auto has chosen, and why; empty where the user named them.
    """

    options: Options
    words: str = ''


def choose(trials: Sequence[Trial], options: Options) -> Choice:
    """
    Decide the options that are open, from the trials: `calibrate` auto, and `evaluations` 0.

    The same trials and options give the same choice; options without an open one stay as they are.
    """
    words = ''
    if options.calibrate == (AUTO,):
        names, words = _parameters(trials)
        options = replace(options, calibrate=names)
    if options.evaluations == 0:
        options = replace(options, evaluations=_evaluations(trials, options))
    return Choice(options, words)


def chooses_parts(trials: Sequence[Trial], options: Options) -> bool:
    """Tell whether cross-validation over the trials chooses rest shape and number of parts."""
    return (options.parts == 0 and options.search == LeastSquares.name and len(trials) > 1
            and 'flexibility' in options.space.free)


def budget(dimension: int) -> int:
    """Return the largest number of evaluations for a search of so many parameters."""
    return max(PAPER_ROUNDS, LINEARISATIONS * (dimension + 1))  # one linearisation takes d + 1


def _evaluations(trials: Sequence[Trial], options: Options) -> int:
    least = budget(options.space.dimension)
    return least + REFINEMENT if chooses_parts(trials, options) else least


def _parameters(trials: Sequence[Trial]) -> tuple[tuple[str, ...], str]:
    """Return the parameters that trials show, and the words for them."""
    shown = motions(trials)
    names: tuple[str, ...] = PAPER_PARAMETERS
    words = f'Calibrated: {", ".join(PAPER_PARAMETERS)}'
    for added, there, why in ((IN_MOTION, shown.seen, 'goals were seen in motion'),
                              (BETWEEN_CLAMPS, shown.between_clamps, 'a motion between two clamps was seen')):
        if there:
            names += added
            words += f'; {", ".join(added)}, because {why}'
    if names == PAPER_PARAMETERS:
        words += f'; not {", ".join(IN_MOTION)}, because no goal was seen in motion'
    return names, f'{words}.'
