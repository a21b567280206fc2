# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pairs: random starts and goals for plans, each a shape in which the DLO stays at rest on a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.experiment.known_dlos import KnownDlo
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, frozen_array
from dlo_calibration.planning.rehearsal import Job, rehearse, Step
from dlo_calibration.simulation.protocol import Simulator

POINTS = 81  # of a simulated chain: one for each node of the finer simulation
SEEN = 4  # a planner sees every fourth of them, which are 21 points
MODES = 4  # of the curvature, with 0 to 3 half waves over the length
BENDS = 3.0  # standard deviation of the amplitude of a mode, times the length
SHARPEST = 12.0  # largest curvature, times the length
APART = 4.0  # smallest distance between parts that are no neighbours, in radii
APART_ALONG = 12.0  # they are no neighbours if more of the DLO lies between them, in radii
DISTANCE = (0.15, 0.30)  # mean distance of the points of start and goal, as a share of the length
TURN = np.pi / 3  # largest rotation between start and goal
TRIES = 1000  # shapes that are drawn for one pair


@dataclass(frozen=True)
class Pair:
    """
    A start and a goal; point i of both is the same material point.

    :param start: POINTS points [m]; so has the goal.
    """

    start: Chain
    goal: Chain


def seen(points: Floats) -> Floats:
    """Return the points that a planner sees, (21, 3) [m], of (81, 3) simulated ones."""
    return points[..., ::SEEN, :]


def share_apart(dlo: KnownDlo, points: Floats, others: Floats) -> float:
    """Return the mean distance of the seen points of two (81, 3) chains [m], as a share of the length."""
    return float(np.linalg.norm(seen(points) - seen(others), axis=-1).mean()) / dlo.length


def random_pair(dlo: KnownDlo, index: int, seed: int, simulator: Simulator) -> Pair:
    """
    Return a random pair of a DLO; it depends on the seed and its index alone.

    Start and goal are random smooth curves without crossings, whose curvature is a sum of MODES cosines.
    The DLO is laid there and let go, and stays as the simulation leaves it at rest.  The goal is then
    turned and moved, so that the points are 15 to 30 % of the length apart on average.

    :param simulator: simulates with the true properties.
    """
    generator = np.random.default_rng([seed, index])
    start = _shape(dlo, generator, simulator)
    apart = generator.uniform(*DISTANCE)
    for _ in range(TRIES):
        goal = _moved(_shape(dlo, generator, simulator), generator.uniform(-TURN, TURN), np.zeros(2))
        if share_apart(dlo, start, goal) < apart:
            break
    else:
        raise RuntimeError(f'{dlo.name}: no goal within {TRIES} tries')
    angle = generator.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    near, far = 0.0, dlo.length  # [m] too little, and too much
    while far - near > 1e-6:
        middle = (near + far) / 2
        enough = share_apart(dlo, start, _moved(goal, 0.0, middle * direction)) > apart
        near, far = (near, middle) if enough else (middle, far)
    return Pair(Chain(start), Chain(_moved(goal, 0.0, far * direction)))


def random_curve(dlo: KnownDlo, generator: np.random.Generator) -> Floats:
    """Return evenly spaced points of a random smooth curve as long as the DLO, (81, 3) [m]."""
    along = np.linspace(0, 1, 4 * (POINTS - 1) + 1)
    waves = np.cos(np.pi * np.arange(MODES)[:, None] * along)
    curvature = np.clip(generator.normal(0, BENDS, MODES) @ waves, -SHARPEST, SHARPEST)
    heading = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2)]) * along[1]
    heading += generator.uniform(-np.pi, np.pi)
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum((steps[1:] + steps[:-1]) / 2, axis=0)])
    points = np.full((POINTS, 3), dlo.radius)
    points[:, :2] = (places[::4] - places.mean(axis=0)) * along[1] * dlo.length
    return points


def clear_of_itself(dlo: KnownDlo, points: Floats) -> bool:
    """Tell whether no part of a DLO with the (n, 3) points [m] crosses another, or nearly touches it."""
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    index = np.arange(len(points))
    along = np.abs(index[:, None] - index[None]) * dlo.length / (len(points) - 1)
    return bool((distances[along > APART_ALONG * dlo.radius] > APART * dlo.radius).all())


def _shape(dlo: KnownDlo, generator: np.random.Generator, simulator: Simulator) -> Floats:
    """Return a random shape at rest, (81, 3) [m], with its middle at the origin."""
    for _ in range(TRIES):
        curve = random_curve(dlo, generator)
        if clear_of_itself(dlo, curve):
            found = laid(dlo, curve, simulator)
            if clear_of_itself(dlo, found):
                return _moved(found, 0.0, -found[:, :2].mean(axis=0))
    raise RuntimeError(f'{dlo.name}: no shape within {TRIES} tries')


def laid(dlo: KnownDlo, points: Floats, simulator: Simulator) -> Floats:
    """Return where a DLO that is laid at (81, 3) points [m] and let go comes to rest."""
    middle = len(points) // 2
    hand = Hand('hand_1', (middle,), np.array([0.0, 0.01]), points[[middle, middle]])
    found, = rehearse(Pool(simulator), [Job(Chain(points), (Step(Action((hand,))),), dlo.physical)])
    return np.asarray(found.chains[-1])


def _moved(points: Floats, angle: float, offset: Floats) -> Floats:
    """Return points turned about the z axis by an angle [rad] and moved by an offset, (2,) [m]."""
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return frozen_array(points @ turn.T + np.append(offset, 0.0))
