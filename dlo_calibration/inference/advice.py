# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Advice: which action, if it were observed next, would tell most about what is not known.

Each candidate is simulated with the found parameters and with values beside
them.  How far the simulated chains then lie apart, against the error of the
residuals, is the information that the trial would add (the expected covariance
of Bayesian experimental design, Chaloner and Verdinelli, Bayesian Experimental
Design: A Review, 1995, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.linearisation import (
    both_sides,
    information,
    slope,
    standard_deviations,
    STEP,
    WIDEST,
)
from dlo_calibration.inference.uncertainty import DEVIATIONS, IDENTIFIABLE_STD, Uncertainty
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, NamedAction, TwoHands
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.excitation import excites
from dlo_calibration.simulation.protocol import Simulator

WORTH_IT = 0.8  # an action is advised that brings the standard deviation below that share of today's
MOST_SIMULATED = 3  # actions that are simulated beside all values


@dataclass(frozen=True, eq=False)
class Candidate:
    """An action that could be observed next, in words and as a trial whose goals are not known yet."""

    action: str
    words: str
    trial: Trial


@dataclass(frozen=True)
class Advice:
    """
    The action that would tell most about a parameter.

    :param action: its name, as in a request.
    :param words: what to do.
    :param parameter: that it would tell about.
    :param std: of that parameter today, in the unit cube.
    :param expected_std: with the action observed, too.
    :param lower: expected 90 % interval in the unit cube, if the value stays; `upper` its other end.
    """

    action: str
    words: str
    parameter: str
    std: float
    expected_std: float
    lower: float
    upper: float


def advise(trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator, point: Floats,
           uncertainty: Uncertainty, length: float,
           should_stop: Callable[[], bool] = lambda: False) -> Advice | None:
    """
    Return the action that reduces the largest uncertainty most; None where none helps, or nothing is open.

    Where none tells about the parameter that is known worst, the next one is looked at, as
    long as it is not known well.  To spend few rollouts, each action that may show it is first simulated
    beside the found value of that parameter only, then the `MOST_SIMULATED` best of them beside all.

    :param point: (d,) the found values in the unit cube.
    :param uncertainty: today's, with a covariance.
    :param length: of the DLO [m].
    """
    if uncertainty.covariance is None:
        return None
    possible, known = list(candidates(trials)), np.linalg.inv(uncertainty.covariance)

    def simulated(candidate: Candidate, shown: NDArray[np.bool_]) -> Floats | None:
        try:
            return sensitivity(candidate.trial, space, simulator, point, uncertainty.std, length, shown=shown)
        except (SimulationError, InputError):
            return None  # cannot be done with this DLO

    for k in np.argsort(-uncertainty.std, kind='stable'):
        now = float(uncertainty.std[k])
        if now < IDENTIFIABLE_STD:
            return None
        alone = np.arange(space.dimension) == k
        promising: list[tuple[float, Candidate, Floats]] = []
        for candidate in list(possible):
            if should_stop():
                return None
            if not excites([candidate.trial], space, np.inf)[0, k]:  # a table may be anywhere
                continue
            matrix = simulated(candidate, alone)
            if matrix is None:
                possible.remove(candidate)
                continue
            # As if all else were known.
            at_best = float((now**-2 + information(matrix, uncertainty.scale)[k, k])**-0.5)
            if at_best < WORTH_IT * now:
                promising.append((at_best, candidate, matrix))
        best: tuple[float, Candidate] | None = None
        for _, candidate, matrix in sorted(promising, key=lambda one: one[0])[:MOST_SIMULATED]:
            if should_stop():
                return None
            rest = simulated(candidate, ~alone)
            if rest is not None:
                std = float(standard_deviations(known + information(matrix + rest, uncertainty.scale))[k])
                if std < WORTH_IT * now and (best is None or std < best[0]):
                    best = std, candidate
        if best is not None:
            std, candidate = best
            reach = DEVIATIONS * std
            return Advice(candidate.action, candidate.words, space.free[k], now, std,
                          max(0.0, float(point[k]) - reach), min(1.0, float(point[k]) + reach))
    return None


def sensitivity(trial: Trial, space: ParameterSpace, simulator: Simulator, point: Floats, std: Floats,
                length: float, *, shown: NDArray[np.bool_] | None = None, at_rest: bool = True) -> Floats:
    """
    Return (m, d) [m per unit cube]: how the simulated chains of a trial change with the parameters.

    Central differences as wide as each parameter is unknown, because the chains need not be linear over
    that.

    :param shown: (d,) False for parameters that are not simulated, as they change nothing; None: all are.
    :param at_rest: refuse rollouts that do not come to rest; else they count as they are at the limit.
    :raises SimulationError: where a rollout diverges, or does not come to rest.
    """
    columns: list[Floats] = []
    steps = np.clip(std, STEP, WIDEST)
    for k in range(len(point)):
        if shown is not None and not shown[k]:
            columns.append(np.zeros(3 * len(trial.goals) * len(trial.initial)))
            continue
        beside, chains = both_sides(point, [k], steps), []
        for one in beside:
            rollout = simulator.simulate(trial, space.physical(space.values(one), length))
            if at_rest and not all(rollout.settled):
                raise SimulationError(f'trial {trial.name!r} does not come to rest')
            chains.append(rollout.chains.ravel())
        column = slope(beside[:, k], chains)
        assert column is not None  # both are there
        columns.append(column)
    return np.stack(columns, axis=1)


def candidates(trials: Sequence[Trial]) -> Iterator[Candidate]:
    """List actions that could be done next, from where a trial began."""
    chain = next((trial.initial for trial in trials if trial.velocity is None), trials[0].initial)
    length = chain.length
    along = chain.points[-1] - chain.points[0]
    across = np.array([-along[1], along[0], 0.0])
    if not np.linalg.norm(across) > 1e-6 * length:
        across = np.array([0.0, 1.0, 0.0])
    side = tuple(float(one) for one in across / np.linalg.norm(across))
    gap = float(np.linalg.norm(along))
    cm = f'{30 * length:.0f} cm'
    for fraction, place in ((0.0, 'the first end'), (0.5, 'the middle')):
        height = 0.4 * length
        yield from _candidate(f'lift {place} by {100 * height:.0f} cm and hold it', chain,
                              LiftAndHold(fraction=fraction, height=height))
        yield from _candidate(f'lift {place} by {100 * height:.0f} cm and watch it while it moves', chain,
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
        return  # the ends are together: there is no line along which to move them
    yield from _candidate(f'grip both ends and push them {100 * gap / 3:.0f} cm together', chain,
                          TwoHands(fractions=(0.0, 1.0), motion='together', distance=gap / 3))
    apart = 1.03 * length - gap
    if apart > 0:
        yield from _candidate(
            f'grip both ends and pull them {100 * apart:.0f} cm apart, 3 % beyond the straight DLO', chain,
            TwoHands(fractions=(0.0, 1.0), motion='apart', distance=apart))


def _beyond(chain: Chain, fraction: float, across: Floats) -> tuple[float, ...]:
    """Return a place a tenth of the length beside the DLO."""
    place = chain.resample(np.array([fraction * chain.length]))[0]
    return tuple(float(one) for one in place - 0.1 * chain.length * across / np.linalg.norm(across))


def _candidate(words: str, chain: Chain, named: NamedAction, watched: bool = False) -> Iterator[Candidate]:
    try:
        action: Action = named.action(chain)
    except InputError:
        return  # not with a chain of this shape
    held = tuple(hand.name for hand in action.hands) if named.hold else ()
    goals = [Goal(chain, action.end + 1.0, held_by=held)]  # it is compared at rest
    if watched:
        times = np.linspace(action.start, action.end, 9)[1:]
        goals = [Goal(chain, float(time), stable=False, held_by=held) for time in times]
    yield Candidate(named.name, words, Trial(words, chain, (action,), tuple(goals)))
