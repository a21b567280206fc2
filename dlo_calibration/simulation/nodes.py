# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""NodeLayout: where the nodes of the simulated DLO lie, and how observed points follow from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats, frozen_array, interpolation_matrix
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import NO_NOISE, noise, smooth


@dataclass(frozen=True)
class NodeLayout:
    """
    Nodes of the simulated DLO.

    :param places: (N,) [m] along the DLO at rest, from 0, increasing; every
        gripped point has a node of its own.
    :param points: (N, 3) [m] at the start.
    :param velocities: (N, 3) [m/s] at the start.
    :param observe: (n, N) weights; with the nodes' positions they give the observed points.
    :param point_places: (n,) [m] of the observed points along the DLO.
    :param features: (N,) share of each node in the points annotated as feature.
    """

    places: Floats
    points: Floats
    velocities: Floats
    observe: Floats
    point_places: Floats
    features: Floats

    def nodes(self, hand: Hand) -> tuple[int, ...]:
        """Return the nodes that a hand grips."""
        return tuple(int(np.abs(self.places - self.point_places[grip]).argmin()) for grip in hand.grips)

    @classmethod
    def of(cls, trial: Trial, count: int) -> NodeLayout:
        """
        Lay out `count` nodes, as equally spaced as the gripped points allow.

        There is none within a clamp that holds from the start: that piece does not bend.
        The initial chain is smoothed as the noise of the trial's chains asks
        for: noise makes a chain longer, and bends a stiff one as nothing real does.

        :raises InputError: where more points are gripped than there can be nodes.
        """
        initial = _without_noise(trial)
        point_places = initial.arc_lengths()
        grips = sorted({grip for hand in trial.hands for grip in hand.grips})
        fixed = np.unique(np.concatenate([[0.0], point_places[grips], point_places[-1:]]))
        if len(fixed) > count:
            raise InputError(f'trial {trial.name!r}', f'{len(grips)} gripped points',
                             f'fewer than the {count} nodes', 'raise the number of nodes')
        pairs = {pair for hand in trial.hands if hand.times[0] <= 0
                 for pair in zip(sorted(hand.grips)[:-1], sorted(hand.grips)[1:], strict=True)
                 if pair[1] == pair[0] + 1}
        rigid = np.isin(fixed[:-1], point_places[[first for first, _ in pairs]])
        places = spread_places(fixed, count, rigid)
        observe = interpolation_matrix(places, point_places)
        velocities = np.zeros((count, 3)) if trial.velocity is None else \
            interpolation_matrix(point_places, places) @ trial.velocity
        return cls(frozen_array(places), frozen_array(initial.resample(places)), frozen_array(velocities),
                   frozen_array(observe), frozen_array(point_places),
                   frozen_array(feature_shares(initial, places)))


def feature_shares(chain: Chain, places: Floats) -> Floats:
    """
    Return how many of the points annotated as feature belong to each node, (N,).

    What is between two nodes goes to both, so that its centre of mass stays in place.

    :param places: (N,) [m] of the nodes along the chain.
    """
    at = chain.arc_lengths()[chain.features]
    after = np.clip(np.searchsorted(places, at), 1, len(places) - 1)
    share = np.clip((at - places[after - 1]) / (places[after] - places[after - 1]), 0.0, 1.0)
    shares = np.zeros(len(places))
    np.add.at(shares, after - 1, 1 - share)
    np.add.at(shares, after, share)
    return shares


def _without_noise(trial: Trial) -> Chain:
    """Return the initial chain, smoothed."""
    sigma = noise([trial])
    if not sigma > NO_NOISE:
        return trial.initial
    return replace(trial.initial, points=smooth(trial.initial.points, sigma))


def spread_places(fixed: Floats, count: int, rigid: NDArray[np.bool_] | None = None) -> Floats:
    """
    Return `count` increasing places that contain the `fixed` ones, the others evenly between.

    :param rigid: (f - 1,) pieces between the f fixed places that stay whole, unless all are; None: none.
    """
    pieces = np.ones(len(fixed) - 1, int)
    widths = np.diff(fixed)
    if rigid is not None and not rigid.all():
        widths[rigid] = 0.0
    while pieces.sum() < count - 1:
        pieces[np.argmax(widths / pieces)] += 1
    parts = [np.linspace(a, b, k, endpoint=False)
             for a, b, k in zip(fixed[:-1], fixed[1:], pieces, strict=True)]
    return np.append(np.concatenate(parts), fixed[-1])
