# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Reality: DLOs with known properties, and a finer simulation of them, in which planned actions are executed.

A pair is a random start and goal for a plan, each a shape in which the DLO stays at rest on a table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, frozen_array
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.planning.rehearsal import ActionStep, RehearsalJob, rehearse
from dlo_calibration.simulation.protocol import Simulator

POINTS = 81  # of a simulated chain: one for each node of the finer simulation
SEEN = 4  # a planner sees every fourth of them, which are 21 points
MODES = 4  # of the curvature, with 0 to 3 half waves over the length
BENDS = 3.0  # standard deviation of the amplitude of a mode of the curvature, times the length
SHARPEST = 12.0  # largest curvature, times the length
APART = 4.0  # smallest distance between parts that are no neighbours, in radii
APART_ALONG = 12.0  # they are no neighbours if more of the DLO lies between them, in radii
DISTANCE = (0.15, 0.30)  # mean distance of the points of start and goal, as a share of the length
TURN = np.pi / 3  # largest rotation between start and goal
TRIES = 1000  # largest number of shapes that are drawn for one pair
HAND_REACH = 0.02  # m; a hand that closes further from the DLO grips nothing


@dataclass(frozen=True)
class KnownDlo:
    """
    A DLO with known properties.

    :param name: of its session in `msg_samples`.
    :param length: [m]; `radius` [m]; `mass` [kg].
    :param bending: bending stiffness EI [N m^2].
    :param stretching: stretching stiffness EA [N].
    :param friction: Coulomb coefficient.
    """

    name: str
    length: float
    radius: float
    mass: float
    bending: float
    stretching: float
    friction: float

    @property
    def values(self) -> dict[str, float]:
        """The paper's four parameters on the 0..100 scale."""
        true = {'flexibility': self.bending, 'elasticity': self.stretching, 'friction': self.friction,
                'self_collision': self.radius}
        return {name: BY_NAME[name].value(physical) for name, physical in true.items()}

    @property
    def physical(self) -> dict[str, float]:
        """Physical values by name, in SI units; parameters beyond the paper's have their defaults."""
        return ParameterSpace(mass=self.mass).physical(self.values, self.length)


#: From the table in msg_samples/README.md.
KNOWN_DLOS: tuple[KnownDlo, ...] = (
    KnownDlo('object1', 0.6, 4e-3, 0.030, 1e-4, 300.0, 0.4),
    KnownDlo('object2', 0.6, 7e-3, 0.090, 2e-3, 800.0, 0.5),
    KnownDlo('object3', 0.6, 2.5e-3, 0.008, 1e-5, 100.0, 0.3),
    KnownDlo('object4', 0.5, 3e-3, 0.020, 3e-4, 4.0, 0.6),
    KnownDlo('object5', 0.6, 10e-3, 0.350, 2e-2, 3000.0, 0.5),
)


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


def relative_distance(dlo: KnownDlo, points: Floats, others: Floats) -> float:
    """Return the mean distance of the seen points of two (81, 3) chains [m], as a share of the length."""
    return float(np.linalg.norm(seen(points) - seen(others), axis=-1).mean()) / dlo.length


def random_pair(dlo: KnownDlo, index: int, seed: int, simulator: Simulator) -> Pair:
    """
    Return a random pair of a DLO; it depends on the seed and its index alone.

    Start and goal are random smooth curves without crossings, whose curvature is a sum of MODES cosines.
    The DLO is laid there, released, and keeps the shape in which it comes to rest.  The goal is then turned
    and moved, so that the points are 15 to 30 % of the length apart on average.

    :param simulator: simulates with the true properties.
    """
    generator = np.random.default_rng([seed, index])
    start = _shape(dlo, generator, simulator)
    distance = generator.uniform(*DISTANCE)
    for _ in range(TRIES):
        goal = _moved(_shape(dlo, generator, simulator), generator.uniform(-TURN, TURN), np.zeros(2))
        if relative_distance(dlo, start, goal) < distance:
            break
    else:
        raise RuntimeError(f'{dlo.name}: no goal within {TRIES} tries')
    angle = generator.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    near, far = 0.0, dlo.length  # [m] too little, and too much
    while far - near > 1e-6:
        middle = (near + far) / 2
        enough = relative_distance(dlo, start, _moved(goal, 0.0, middle * direction)) > distance
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
            points = laid(dlo, curve, simulator)
            if clear_of_itself(dlo, points):
                return _moved(points, 0.0, -points[:, :2].mean(axis=0))
    raise RuntimeError(f'{dlo.name}: no shape within {TRIES} tries')


def laid(dlo: KnownDlo, points: Floats, simulator: Simulator) -> Floats:
    """Return the points at rest of a DLO that is laid at (81, 3) points [m] and released."""
    middle = len(points) // 2
    hand = Hand('hand_1', (middle,), np.array([0.0, 0.01]), points[[middle, middle]])
    job = RehearsalJob(Chain(points), (ActionStep(Action((hand,))),), dlo.physical)
    rehearsal, = rehearse(Pool(simulator), [job])
    return np.asarray(rehearsal.chains[-1])


def _moved(points: Floats, angle: float, offset: Floats) -> Floats:
    """Return points turned about the z axis by an angle [rad] and moved by an offset, (2,) [m]."""
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return frozen_array(points @ turn.T + np.append(offset, 0.0))


class Reality:
    """
    A DLO on a table, in which hands execute planned actions, wherever the DLO may be.

    A hand closes at its first waypoint and grips the point of the DLO that is nearest to it, if that is
    within HAND_REACH.  Then it moves along its path, with the grip as far from its middle as when it closed.

    :param start: (N, 3) [m] points at rest, one for each node of the simulator.
    """

    def __init__(self, dlo: KnownDlo, start: Chain, simulator: Simulator) -> None:
        self.points = start.points  # (N, 3) [m] where the DLO is at rest now
        self._start = start
        self._physical = dlo.physical
        self._pool = Pool(simulator)
        self._steps: list[ActionStep] = []

    @property
    def steps(self) -> tuple[ActionStep, ...]:
        """The executed steps so far."""
        return tuple(self._steps)

    def act(self, action: Action) -> bool:
        """
        Execute an action, after which all hands open; tell whether every hand gripped the DLO.

        :raises SimulationError: if the simulation diverges.
        """
        hands = tuple(hand for planned in action.hands if (hand := self._gripping(planned)) is not None)
        if hands:
            # All actions are simulated again, because a chain does not show how much the DLO is stretched.
            steps = (*self._steps, ActionStep(Action(hands)))
            rehearsal, = rehearse(self._pool, [RehearsalJob(self._start, steps, self._physical)])
            if rehearsal.failure:
                raise SimulationError(rehearsal.failure)
            self._steps, self.points = list(steps), rehearsal.chains[-1]
        return len(hands) == len(action.hands)

    def _gripping(self, hand: Hand) -> Hand | None:
        """Return the path of a hand with the point that it really grips; None if it closes on nothing."""
        distances = np.linalg.norm(self.points - hand.positions[0], axis=1)
        nearest = int(distances.argmin())
        return replace(hand, grips=(nearest,)) if distances[nearest] <= HAND_REACH else None
