# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Advice: the action to observe next, so that the least certain parameter becomes more certain.

It is chosen among actions that can be done with nearly any DLO, and said in words, by what each of them is
expected to tell, see `expectation`.  Likewise, `workspace.next_action` seeks among what given hands may do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.inference.draws import drawn_points
from dlo_calibration.inference.expectation import Expectation
from dlo_calibration.inference.together import CORRELATED
from dlo_calibration.inference.uncertainty import DEVIATIONS, IDENTIFIABLE_WIDTH, Uncertainty
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, NamedAction, TwoHands
from dlo_calibration.model.parameters import BY_NAME, number, ParameterSpace, SCALE
from dlo_calibration.model.trial import Goal, Trial

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
           uncertainty: Uncertainty, length: float, noise: float = 0.0) -> Advice | None:
    """
    Return the action that is expected to tell most of the parameters that are not identifiable.

    To save time, there is one draw, near the found values, and only the least certain parameters are varied,
    with what is known only together with them.

    :param point: (d,) the found values in the box.
    :param uncertainty: of the parameters now.
    :param length: of the DLO [m].
    :param noise: noise level: standard deviation of one measured coordinate [m].
    :return: None if no action helps, every parameter is identifiable, or there is no covariance.
    :raises CancelledError: when stopped.
    """
    std, enough = uncertainty.std, IDENTIFIABLE_WIDTH / 2 / DEVIATIONS
    sought = np.argsort(-std, kind='stable')[:MOST_SOUGHT]
    sought = sought[std[sought] > enough]
    if uncertainty.correlations is None or not len(sought):
        return None
    # What is known only together with another parameter becomes certain by what shows either.
    varied = np.asarray((np.abs(uncertainty.correlations[sought]) >= CORRELATED).any(axis=0))
    possible = list(candidates(trials))
    expectation = Expectation.of(
        [candidate.trial for candidate in possible], space, pool,
        drawn_points(point, uncertainty, 1, 0), uncertainty, uncertainty.scale, length,
        np.full(len(std), enough), noise, varied)
    for k in expectation.ranked:
        expected = expectation.expected(k)
        most = int(sought[np.argmin((expected / std)[sought])])
        if expected[most] < WORTH_IT * std[most]:
            reach = DEVIATIONS * float(expected[most])
            return Advice(possible[k].action, possible[k].words, space.free[most], float(std[most]),
                          float(expected[most]), max(0.0, float(point[most]) - reach),
                          min(float(space.upper[most]), float(point[most]) + reach))
    return None


def candidates(trials: Sequence[Trial]) -> Iterator[Candidate]:
    """Yield actions that could be observed next, starting from the initial chain of a trial."""
    chain = next((trial.initial for trial in trials if trial.velocity is None), trials[0].initial)
    if not chain.seen.all():
        chain = chain.interpolated(chain.arc_lengths())
    length = chain.length
    along = chain.points[-1] - chain.points[0]
    across = np.array([-along[1], along[0], 0.0])
    if not np.linalg.norm(across) > 1e-6 * length:
        across = np.array([0.0, 1.0, 0.0])
    side = tuple((across / np.linalg.norm(across)).tolist())
    gap = float(np.linalg.norm(along))
    cm = centimetres(0.3 * length)
    for fraction, place in ((0.0, 'the first end'), (0.5, 'the middle')):
        height = 0.4 * length
        yield from _candidate(f'lift {place} by {centimetres(height)} and hold it', chain,
                              LiftAndHold(fraction=fraction, height=height))
        yield from _candidate(f'lift {place} by {centimetres(height)} and watch it while it moves', chain,
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
    yield from _candidate(f'grip both ends and push them {centimetres(gap / 3)} together', chain,
                          TwoHands(fractions=(0.0, 1.0), motion='together', distance=gap / 3))
    stretch = 1.03 * length - gap
    if stretch > 0:
        yield from _candidate(
            f'grip both ends and pull them {centimetres(stretch)} apart, 3 % beyond the straight DLO', chain,
            TwoHands(fractions=(0.0, 1.0), motion='apart', distance=stretch))


def centimetres(length: float) -> str:
    """Return a length [m] for people, with two digits."""
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
