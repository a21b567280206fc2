# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Advice: the action to observe next, so that the least certain parameter becomes more certain.

Each candidate is simulated with the found parameters and beside them.  The derivatives of the simulated
chains, divided by the error of the residuals, give the information that the trial would add (the expected
covariance of Bayesian experimental design: Chaloner and Verdinelli, Bayesian Experimental Design: A
Review, 1995, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from operator import itemgetter
from typing import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.evaluation import with_hands
from dlo_calibration.evaluation.linearisation import (
    Differences,
    information,
    standard_deviations,
    STEP,
    WIDEST,
)
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.inference.together import CORRELATED
from dlo_calibration.inference.uncertainty import DEVIATIONS, IDENTIFIABLE_WIDTH, Uncertainty
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, NamedAction, TwoHands
from dlo_calibration.model.parameters import BY_NAME, number, ParameterSpace, SCALE
from dlo_calibration.model.score import force_residuals
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.excitation import excites

MOST_SOUGHT = 6  # largest number of parameters for which an action is sought, to save time
WORTH_IT = 0.8  # an advised action reduces the standard deviation to less than this share


@dataclass(frozen=True, eq=False)
class Candidate:
    """An action that could be observed next, in words and as a trial whose goal chains are placeholders."""

    action: str
    words: str
    trial: Trial


@dataclass(frozen=True)
class Advice:
    """
    The action that would reduce the standard deviation of a parameter most.

    :param action: its name, as in a request.
    :param words: what to do.
    :param parameter: the name of the parameter.
    :param std: its present standard deviation in units of a search.
    :param expected_std: its expected standard deviation after the action was observed.
    :param lower: lower end of the expected 90 % interval in the box, around the present value;
        `upper` is its upper end.
    """

    action: str
    words: str
    parameter: str
    std: float
    expected_std: float
    lower: float
    upper: float

    @property
    def of_hundred(self) -> dict[str, float]:
        """The standard deviations and the interval on the 0..100 scale."""
        scale = SCALE / BY_NAME[self.parameter].extent
        return {key: getattr(self, key) * scale for key in ('std', 'expected_std', 'lower', 'upper')}


def advise(trials: Sequence[Trial], space: ParameterSpace, pool: Pool, point: Floats,
           uncertainty: Uncertainty, length: float) -> Advice | None:
    """
    Return the action that reduces the largest standard deviation most.

    The parameters are tried from the least certain one on, until an action helps, the others are
    identifiable, or actions were simulated for `MOST_SOUGHT` of them.  To save rollouts, only this parameter,
    and what is known only together with it, is varied at first; the others are varied for the three best
    actions alone.

    :param point: (d,) the found values in the box.
    :param uncertainty: of the parameters now.
    :param length: of the DLO [m].
    :return: None if no action helps, every parameter is identifiable, or there is no covariance.
    :raises CancelledError: when stopped.
    """
    if uncertainty.covariance is None:
        return None
    assert uncertainty.correlations is not None
    correlations = uncertainty.correlations
    possible, present = list(candidates(trials)), np.linalg.inv(uncertainty.covariance)

    def derivatives(actions: Sequence[Candidate], varied: NDArray[np.bool_]
                    ) -> list[Floats | SimulationError]:
        return sensitivities([candidate.trial for candidate in actions], space, pool, point,
                             uncertainty.std, length, shown=np.tile(varied, (len(actions), 1)))

    sought: set[int] = set()
    for k in np.argsort(-uncertainty.std, kind='stable').tolist():
        now = float(uncertainty.std[k])
        if 2 * DEVIATIONS * now <= IDENTIFIABLE_WIDTH or len(sought) == MOST_SOUGHT:
            return None
        # What is known only together with another parameter becomes certain by what shows either.
        alone = np.abs(correlations[k]) >= CORRELATED
        alone[k] = True
        own = int(np.flatnonzero(alone).tolist().index(k))
        deviations = uncertainty.std[alone]
        before = np.linalg.inv(correlations[np.ix_(alone, alone)] * np.outer(deviations, deviations))
        promising: list[tuple[float, Candidate, Floats]] = []
        showing = [candidate for candidate in possible  # inf: a table may have any height
                   if excites([candidate.trial], space, np.inf)[0, alone].any()]
        if showing:
            sought.add(k)
        for candidate, column in zip(showing, derivatives(showing, alone), strict=True):
            if isinstance(column, SimulationError):  # this DLO does not allow the action
                possible.remove(candidate)
                continue
            # An upper bound of the gain: the other parameters count as known.
            gained = information(column, uncertainty.scale)[np.ix_(alone, alone)]
            at_best = float(standard_deviations(before + gained)[own])
            if at_best < WORTH_IT * now:
                promising.append((at_best, candidate, column))
        best: tuple[float, Candidate] | None = None
        promising = sorted(promising, key=itemgetter(0))[:3]
        others = derivatives([candidate for _, candidate, _ in promising], ~alone)
        for (_, candidate, column), rest in zip(promising, others, strict=True):
            if not isinstance(rest, SimulationError):
                std = float(standard_deviations(present + information(column + rest, uncertainty.scale))[k])
                if std < WORTH_IT * now and (best is None or std < best[0]):
                    best = std, candidate
        if best is not None:
            std, candidate = best
            reach, end = DEVIATIONS * std, float(space.upper[k])
            return Advice(candidate.action, candidate.words, space.free[k], now, std,
                          max(0.0, float(point[k]) - reach), min(end, float(point[k]) + reach))
    return None


def sensitivities(trials: Sequence[Trial], space: ParameterSpace, pool: Pool, point: Floats, std: Floats,
                  length: float, *, shown: NDArray[np.bool_], at_rest: bool = True,
                  recorded: bool = False) -> list[Floats | SimulationError]:
    """
    Return the (m, d) derivatives of the simulated chains, and then forces, of each trial [m per unit].

    The central differences have steps of the standard deviations, because the chains may be nonlinear within
    such a distance.

    :param std: (d,) standard deviations in units of a search.
    :param length: of the DLO [m].
    :param shown: (trials, d) False for parameters that a trial cannot show: their columns are zero without a
        rollout.
    :param at_rest: whether to refuse a rollout that does not come to rest; if not, its last state counts.
    :param recorded: whether the hands of the trials have the errors of their parameters; those of planned
        trials have none.
    :return: for a trial without derivatives the reason: a rollout diverges, or does not come to rest.
    :raises CancelledError: when stopped.
    """
    steps = np.clip(std, STEP, WIDEST)
    sides = [Differences.central(point, np.flatnonzero(row), steps, space.upper) for row in shown]
    jobs = []
    for trial, differences in zip(trials, sides, strict=True):
        for beside in differences.points:
            physical = space.physical(space.values(beside), length)
            jobs.append((with_hands(trial, physical) if recorded else trial, physical))
    rollouts = iter(pool.simulate(jobs))
    derivatives: list[Floats | SimulationError] = []
    for trial, differences in zip(trials, sides, strict=True):
        chains, failure = [], None
        for rollout in islice(rollouts, len(differences.points)):
            if isinstance(rollout, SimulationError):
                failure = rollout
            elif at_rest and not all(rollout.settled):
                failure = SimulationError(f'trial {trial.name!r} does not come to rest')
            else:
                chains.append(np.append(rollout.chains, force_residuals(trial, rollout.forces)))
        count = len(trial.goals) * len(trial.initial) + len(trial.forces)
        unknown = np.zeros((3 * count, len(point)))
        derivatives.append(differences.jacobian(unknown, chains) if failure is None else failure)
    return derivatives


def candidates(trials: Sequence[Trial]) -> Iterator[Candidate]:
    """Yield actions that could be observed next, starting from the initial chain of a trial."""
    chain = next((trial.initial for trial in trials if trial.velocity is None), trials[0].initial)
    length = chain.length
    along = chain.points[-1] - chain.points[0]
    across = np.array([-along[1], along[0], 0.0])
    if not np.linalg.norm(across) > 1e-6 * length:
        across = np.array([0.0, 1.0, 0.0])
    side = tuple((across / np.linalg.norm(across)).tolist())
    gap = float(np.linalg.norm(along))
    cm = _centimetres(0.3 * length)
    for fraction, place in ((0.0, 'the first end'), (0.5, 'the middle')):
        height = 0.4 * length
        yield from _candidate(f'lift {place} by {_centimetres(height)} and hold it', chain,
                              LiftAndHold(fraction=fraction, height=height))
        yield from _candidate(f'lift {place} by {_centimetres(height)} and watch it while it moves', chain,
                              LiftAndHold(fraction=fraction, height=height, speed=0.5), watched=True)
    for fraction, place in ((0.0, 'the first end'), (0.25, 'a quarter of the length'), (0.5, 'the middle')):
        yield from _candidate(f'drag {place} sideways by {cm}', chain,
                              Drag(fraction=fraction, direction=side, distance=0.3 * length))
        yield from _candidate(f'lift {place} and put it down {cm} to the side', chain,
                              GraspAndPlace(fraction=fraction, direction=side, distance=0.3 * length))
    yield from _candidate(
        'lift the first end and lay it across the DLO, beyond two thirds of it', chain,
        GraspAndPlace(fraction=0.0, to=_beyond(chain, 0.7, across)))
    if gap < 0.05 * length:
        return  # the ends touch each other, so that no direction is defined
    yield from _candidate(f'grip both ends and push them {_centimetres(gap / 3)} together', chain,
                          TwoHands(fractions=(0.0, 1.0), motion='together', distance=gap / 3))
    stretch = 1.03 * length - gap
    if stretch > 0:
        yield from _candidate(
            f'grip both ends and pull them {_centimetres(stretch)} apart, 3 % beyond the straight DLO', chain,
            TwoHands(fractions=(0.0, 1.0), motion='apart', distance=stretch))


def _centimetres(length: float) -> str:
    return f'{number(float(f"{100 * length:.2g}"))} cm'


def _beyond(chain: Chain, fraction: float, across: Floats) -> tuple[float, ...]:
    """Return the (3,) place [m] a tenth of the length beside the DLO, at a fraction of its arc length."""
    place = chain.resample(np.array([fraction * chain.length]))[0]
    return tuple((place - 0.1 * chain.length * across / np.linalg.norm(across)).tolist())


def _candidate(words: str, chain: Chain, named: NamedAction, watched: bool = False) -> Iterator[Candidate]:
    try:
        action: Action = named.action(chain)
    except InputError:
        return  # the shape of this chain does not allow the action
    held = tuple(hand.name for hand in action.hands) if named.hold else ()
    goals = [Goal(chain, action.end + 1.0, held_by=held)]  # a stable goal: the DLO is compared at rest
    if watched:
        times = np.linspace(action.start, action.end, 9)[1:]
        goals = [Goal(chain, float(time), stable=False, held_by=held) for time in times]
    yield Candidate(named.name, words, Trial(words, chain, (action,), tuple(goals)))
