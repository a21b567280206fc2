# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""NodeLayout: the places of the nodes of the simulated DLO, and their relation to the observed points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
import heapq

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats, frozen_array, grip_place, interpolation_matrix
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.material import clamp_directions
from dlo_calibration.observation.noise import NO_NOISE, noise, noise_of, smooth
from dlo_calibration.observation.table import rest_on
from dlo_calibration.simulation import core

MERGING = 0.15  # of the mean distance of nodes; grips that are nearer share a node


@dataclass(frozen=True)
class NodeLayout:
    """
    Nodes of the simulated DLO.

    :param places: (N,) [m] arc lengths of the nodes at rest, from 0, increasing; there is a
        node at every place that a hand grips.
    :param points: (N, 3) [m] positions of the nodes at the start.
    :param velocities: (N, 3) [m/s] at the start.
    :param observe: (n, N) weights; their product with the nodes' positions is the observed points.
    :param point_places: (n,) [m] arc lengths of the observed points.
    :param features: (N,) number of points annotated as feature at each node, see `feature_shares`.
    :param directions: (N - 1, 3) unit vectors across the segments in clamps that hold from the start, see
        `clamp_directions`; nan elsewhere.
    """

    places: Floats
    points: Floats
    velocities: Floats
    observe: Floats
    point_places: Floats
    features: Floats
    directions: Floats

    def start(self, level: float | None) -> core.Start:
        """Return the start of the nodes; those that rest are moved to a level [m], unless it is None."""
        points = self.points if level is None else rest_on(self.points, level)
        return core.Start(self.places, points, self.velocities, self.features, self.directions)

    def nodes(self, hand: Hand) -> tuple[int, ...]:
        """Return the nodes that a hand grips."""
        return tuple(int(np.abs(self.places - grip_place(self.point_places, grip, hand.offset)).argmin())
                     for grip in hand.grips)

    @classmethod
    def of(cls, trial: Trial, count: int) -> NodeLayout:
        """
        Return a layout of `count` nodes, as equally spaced as the gripped points allow.

        No node lies inside a clamp that holds from the start, because this piece does not bend.
        The initial chain is smoothed according to the noise level of the trial's chains: noise
        makes a chain longer, and bends a stiff DLO more than is possible. If the trial has the arc
        lengths at rest, each node starts between the same two points, at the same share, as at rest.

        :raises InputError: if more points are gripped than there are nodes.
        """
        initial = _smoothed_start(trial)
        along = initial.arc_lengths()
        point_places = along if trial.places is None else trial.places
        fixed = _fixed_places(trial, point_places, count)
        if len(fixed) > count:
            grips = {(grip, hand.offset) for hand in trial.hands for grip in hand.grips}
            raise InputError(f'trial {trial.name!r}', f'{len(grips)} gripped points',
                             f'fewer than the {count} nodes', 'raise the number of nodes')
        rigid = np.isin(fixed[:-1], point_places[list(trial.clamped)])
        places = spread_places(fixed, count, rigid)
        observe = interpolation_matrix(places, point_places)
        velocities = np.zeros((count, 3)) if trial.velocity is None else \
            interpolation_matrix(point_places, places) @ trial.velocity
        start = places if trial.places is None else np.interp(places, point_places, along)
        points = initial.resample(start)
        layout = cls(frozen_array(places), frozen_array(points), frozen_array(velocities),
                     frozen_array(observe), frozen_array(point_places),
                     frozen_array(feature_shares(initial, start)), np.full((count - 1, 3), np.nan))
        return replace(layout, directions=frozen_array(clamp_directions(
            points, [(layout.nodes(hand), hand) for hand in trial.hands if hand.times[0] <= 0])))


def _fixed_places(trial: Trial, places: Floats, count: int) -> Floats:
    """
    Return the arc lengths [m] at which nodes must lie: both ends, gripped points, and grips between points.

    A grip between points shares the node of another of these places if that is nearer than MERGING: short
    segments would be stiff, and a hand that regrips a place does not close at exactly the same arc length.
    """
    points = [places[grip] for hand in trial.hands if not hand.offset for grip in hand.grips]
    fixed = np.unique(np.concatenate([[0.0], points, places[-1:]]))
    between = [hand for hand in trial.hands if hand.offset]
    for place in sorted(grip_place(places, hand.grips[0], hand.offset) for hand in between):
        if np.abs(fixed - place).min() > MERGING * places[-1] / (count - 1):
            fixed = np.sort(np.append(fixed, place))
    return fixed


def feature_shares(chain: Chain, places: Floats) -> Floats:
    """
    Return the number of points annotated as feature at each node, (N,), with fractions.

    A point between two nodes is divided between them so that the centre of mass stays in place.

    :param places: (N,) [m] arc lengths of the nodes.
    """
    at = chain.arc_lengths()[chain.features]
    after = np.clip(np.searchsorted(places, at), 1, len(places) - 1)
    share = np.clip((at - places[after - 1]) / (places[after] - places[after - 1]), 0.0, 1.0)
    shares = np.zeros(len(places))
    np.add.at(shares, after - 1, 1 - share)
    np.add.at(shares, after, share)
    return shares


def _smoothed_start(trial: Trial) -> Chain:
    """Return the initial chain, smoothed according to the noise level of the trial."""
    if all(goal.chain is trial.initial for goal in trial.goals):
        return _smoothed_alone(trial.initial, 1 + len(trial.goals))
    return _smoothed(trial.initial, noise([trial]))


@lru_cache(maxsize=8)
def _smoothed_alone(initial: Chain, count: int) -> Chain:
    """Return the smoothed initial chain of a trial whose `count` chains are all this one, as in a plan."""
    return _smoothed(initial, noise_of([np.stack([initial.observed] * count)]))


def _smoothed(initial: Chain, sigma: float) -> Chain:
    if not sigma > NO_NOISE:
        return initial
    return replace(initial, points=smooth(initial.points, sigma))


def spread_places(fixed: Floats, count: int, rigid: NDArray[np.bool_] | None = None) -> Floats:
    """
    Return `count` increasing arc lengths [m]: the (f,) `fixed` ones, and others as evenly as possible.

    :param rigid: (f - 1,) pieces between fixed places that get no others inside, unless all are rigid.
    """
    pieces = np.ones(len(fixed) - 1, int)
    widths = np.diff(fixed)
    if rigid is not None and not rigid.all():
        widths[rigid] = 0.0
    longest = [(-width, k) for k, width in enumerate(widths.tolist())]
    heapq.heapify(longest)
    for _ in range(count - 1 - len(pieces)):
        k = longest[0][1]
        pieces[k] += 1
        heapq.heapreplace(longest, (-widths[k] / pieces[k], k))
    parts = [np.linspace(a, b, k, endpoint=False)
             for a, b, k in zip(fixed[:-1], fixed[1:], pieces, strict=True)]
    return np.append(np.concatenate(parts), fixed[-1])
