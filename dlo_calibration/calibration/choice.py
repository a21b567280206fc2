# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Choice: decides, from the trials, the options that a user leaves open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

from dlo_calibration.calibration.options import AUTO, Options
from dlo_calibration.errors import InputError
from dlo_calibration.model.parameters import LOCKING, OWN_SHAPE, PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.excitation import motions
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.search import LeastSquares

#: What `calibrate` auto adds to the paper's parameters.
IN_MOTION = ('damping', 'internal_damping')
BETWEEN_CLAMPS = ('torsion', 'bending_friction', 'bending_slip')

DECIDED = ('calibrate', 'evaluations')  # names of the options that may be open

PAPER_ROUNDS = 150  # evaluations; enough for the paper's four parameters
LINEARISATIONS = 15  # in the budget of a search; a Gauss-Newton descent needs about 10
VALLEYS = 100  # evaluations, beside those, in which least squares looks along valleys
REFINEMENT = 400  # evaluations, beside those of one search, to choose rest shape and parts


@dataclass(frozen=True)
class Choice:
    """
    The options of a calibration, all of them decided.

    :param words: which parameters `calibrate` auto has chosen, and why; empty if the user named them.
    :param corrected: names of the options of the hands that auto has set to what the chains show.
    """

    options: Options
    words: str = ''
    corrected: tuple[str, ...] = ()


def choose(trials: Sequence[Trial], options: Options, evidence: GripEvidence | None = None) -> Choice:
    """
    Decide the options that are open, from the trials: `calibrate` auto, and `evaluations` 0.

    The same trials and options give the same choice. Options that leave nothing open do not change.

    :param evidence: what the trials show of the hands, if it is known already.
    :raises InputError: if nothing would choose whether sessions have rest shapes of their own.
    """
    words, errors = '', dict[str, float]()
    if options.calibrate == (AUTO,):
        names, words = _parameters(trials, options)
        options = replace(options, calibrate=names)
        # Chains show the errors of hands better than a simulation, whose grips are at its nodes.
        evidence = evidence or GripEvidence.of(trials)
        errors = {name: evidence.errors[name] for name in _unset(evidence, options)}
        if errors:
            options = Options.of({**options.flat(), **errors})
            words += f' Corrected: {", ".join(errors)}, because {evidence.words(errors)}.'
    if OWN_SHAPE in options.own and not chooses_parts(trials, options):
        raise InputError('parameter own', f'{OWN_SHAPE}, which cross-validation of several trials chooses',
                         f'search {LeastSquares.name}, parts 0, and flexibility among the parameters to find',
                         f'change these options, or leave {OWN_SHAPE} out')
    if options.evaluations == 0:
        ladders = chooses_parts(trials, options) * (
            1 + may_lock(options.space) + (OWN_SHAPE in options.own))
        rounds = budget(options.space.dimension) + REFINEMENT * ladders
        rounds += VALLEYS * (options.search == LeastSquares.name)
        options = replace(options, evaluations=rounds)
    return Choice(options, words, tuple(errors))


def chooses_parts(trials: Sequence[Trial], options: Options) -> bool:
    """Tell whether cross-validation over the trials chooses rest shape and number of parts."""
    return (options.parts == 0 and options.search == LeastSquares.name and len(trials) > 1
            and 'flexibility' in options.space.free)


def may_lock(space: ParameterSpace) -> bool:
    """Tell whether cross-validation chooses if a DLO locks: friction between its strands is calibrated."""
    return 'bending_friction' in space.free and LOCKING not in space.free and not space.fixed.get(LOCKING)


def budget(dimension: int) -> int:
    """Return the default budget of a search: its largest number of evaluations."""
    return max(PAPER_ROUNDS, LINEARISATIONS * (dimension + 1))  # one linearisation takes d + 1


def _parameters(trials: Sequence[Trial], options: Options) -> tuple[tuple[str, ...], str]:
    """Return the parameters that the trials show, and a sentence that says why."""
    moving, between_clamps = motions(trials)
    names: tuple[str, ...] = PAPER_PARAMETERS
    words = f'Calibrated: {", ".join(PAPER_PARAMETERS)}'
    for added, there, why in ((IN_MOTION, moving, 'goals were seen in motion'),
                              (BETWEEN_CLAMPS, between_clamps, 'a motion between two clamps was seen')):
        if there:
            names += added
            words += f'; {", ".join(added)}, because {why}'
    if not options.mass and tell_mass(trials):
        names += ('mass',)
        words += '; mass, because forces on the hands were measured'
    if not any(name in names for name in IN_MOTION):
        words += f'; not {", ".join(IN_MOTION)}, because no goal was seen in motion'
    return names, f'{words}.'


def tell_mass(trials: Sequence[Trial]) -> bool:
    """Tell whether a force on a hand was measured, or of a sensor with an unknown offset, a difference."""
    return any(any(force.tared for *_, force in trial.forces)
               or len({k for k, *_ in trial.forces}) > 1 for trial in trials)


def hand_error(evidence: GripEvidence, options: Options) -> str:
    """Return an error of the hands that is not corrected, with a remedy; '' if there is none."""
    left = [name for name in _unset(evidence, options) if not _is_calibrated(name, options)]
    return f'{evidence.words(left)}; add {" and ".join(left)} to calibrate' \
        if left else ''


def hand_warnings(evidence: GripEvidence, options: Options, corrected: Sequence[str] = ()
                  ) -> tuple[str, ...]:
    """
    Return warnings about errors of the stamps and places of the hands.

    :param corrected: names of the options of the hands that a choice has set.
    """
    automatic = options.calibrate == (AUTO,)
    corrected = _unset(evidence, options) if automatic else corrected
    calibrated = [] if automatic else [name for name in evidence.errors if name in options.calibrate]
    words = [f'{evidence.words(names)}: {remedy} as {", ".join(names)}'
             for names, remedy in ((corrected, 'corrected'), (calibrated, 'calibrated')) if names]
    return (*words, *filter(None, [hand_error(evidence, options)]))


def _unset(evidence: GripEvidence, options: Options) -> list[str]:
    """Return the errors of the hands whose values the user has not given."""
    return [name for name in evidence.errors if not getattr(options, name)]


def _is_calibrated(name: str, options: Options) -> bool:
    return options.calibrate == (AUTO,) or name in options.calibrate
