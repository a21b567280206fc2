# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Choice: decides, from the trials, the options that a user leaves open."""

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
LINEARISATIONS = 15  # in the budget of a search; a Gauss-Newton descent takes about 10
REFINEMENT = 400  # evaluations, beside those of one search, to choose rest shape and parts


@dataclass(frozen=True)
class Choice:
    """
    The options of a calibration, all of them decided.

    :param words: which parameters `calibrate` auto has chosen, and why; empty if the user named them.
    """

    options: Options
    words: str = ''


def choose(trials: Sequence[Trial], options: Options) -> Choice:
    """
    Decide the options that are open, from the trials: `calibrate` auto, and `evaluations` 0.

    The same trials and options give the same choice. Options that leave nothing open do not change.
    """
    words = ''
    if options.calibrate == (AUTO,):
        names, words = _parameters(trials)
        options = replace(options, calibrate=names)
    if options.evaluations == 0:
        rounds = budget(options.space.dimension) + REFINEMENT * chooses_parts(trials, options)
        options = replace(options, evaluations=rounds)
    return Choice(options, words)


def chooses_parts(trials: Sequence[Trial], options: Options) -> bool:
    """Tell whether cross-validation over the trials chooses rest shape and number of parts."""
    return (options.parts == 0 and options.search == LeastSquares.name and len(trials) > 1
            and 'flexibility' in options.space.free)


def budget(dimension: int) -> int:
    """Return the default budget of a search: its largest number of evaluations."""
    return max(PAPER_ROUNDS, LINEARISATIONS * (dimension + 1))  # one linearisation takes d + 1


def _parameters(trials: Sequence[Trial]) -> tuple[tuple[str, ...], str]:
    """Return the parameters that the trials excite, and a sentence that says why."""
    moving, between_clamps = motions(trials)
    names: tuple[str, ...] = PAPER_PARAMETERS
    words = f'Calibrated: {", ".join(PAPER_PARAMETERS)}'
    for added, there, why in ((IN_MOTION, moving, 'goals were seen in motion'),
                              (BETWEEN_CLAMPS, between_clamps, 'a motion between two clamps was seen')):
        if there:
            names += added
            words += f'; {", ".join(added)}, because {why}'
    if names == PAPER_PARAMETERS:
        words += f'; not {", ".join(IN_MOTION)}, because no goal was seen in motion'
    return names, f'{words}.'
