# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
What rendered films show: ropes, looks, cameras, and what a hand does.

The first ten were made with the tracker in mind; in two of them, the camera is held in the hand.  Those with
a number from 10 on are random: colours, ground, lamp, camera, thickness and flexibility, what is moved and
how, and from where the hand comes.
"""

from dataclasses import dataclass, replace
from functools import cache
import math
from pathlib import Path
import sys
from typing import Iterator

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / 'test' / 'support'))

from photographs import Camera, Look  # noqa: E402

from dlo_calibration.calibration.engines import make_simulator  # noqa: E402
from dlo_calibration.calibration.options import Options  # noqa: E402
from dlo_calibration.model.chain import Chain, Floats  # noqa: E402
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, NamedAction  # noqa: E402
from dlo_calibration.model.trial import Goal, Trial  # noqa: E402

FILMS = 10  # which are no random ones
RATE = 30.0  # images a second
SIZE, FOCAL = (1920, 1080), 1500.0  # px
SMALL = 2 / 3  # of that, in random films
LENGTH, RADIUS, MASS = 0.6, 0.004, 0.03  # m, m, kg
FINE = {'mass': MASS, 'engine': 'compiled', 'nodes': 121, 'time_step': 0.001}
REST, APPROACH, SETTLE = 1.2, 0.9, 0.8  # s
AWAY, ARM = 0.5 * np.array([0.1, -1.0, 0.25]), -1.5  # m, from where the hand comes; rad, where its arm is
LOOKS = (
    Look(ground='wood', ground_colour=(0.72, 0.55, 0.38), ground_contrast=0.1, colour=(0.10, 0.24, 0.55)),
    Look(colour=(0.75, 0.15, 0.1), lamp=(0.5, 0.7)),
    Look(ground='cloth', ground_colour=(0.22, 0.25, 0.30), colour=(0.92, 0.92, 0.90), lamp=(-1.0, 0.8)),
    Look(ground='wood', ground_colour=(0.72, 0.55, 0.38), ground_contrast=0.1, colour=(0.93, 0.93, 0.9)),
    Look(ground_colour=(0.85, 0.80, 0.72), colour=(0.12, 0.12, 0.14), lamp=(2.5, 0.7)),
)
ACTIONS: tuple[tuple[NamedAction, ...], ...] = (
    (Drag(fraction=0.4, direction=(0.1, 1, 0), distance=0.12),
     GraspAndPlace(fraction=1.0, direction=(-0.1, 0.12, 0), distance=0.156, height=0.1)),
    (Drag(fraction=1.0, direction=(-1, 1, 0), distance=0.18),
     Drag(fraction=0.5, direction=(0, -1, 0), distance=0.1)),
    (GraspAndPlace(fraction=0.0, direction=(1.0, 0.5, 0), distance=0.2, height=0.06),
     Drag(fraction=0.7, direction=(0.2, -1, 0), distance=0.12)),
    (Drag(fraction=0.0, direction=(1, -0.8, 0), distance=0.2),
     GraspAndPlace(fraction=0.6, direction=(0, 1, 0), distance=0.15, height=0.08)),
    # The end goes over the middle: a crossing.
    (GraspAndPlace(fraction=1.0, direction=(-1.0, 0.45, 0), distance=0.3, height=0.07),
     GraspAndPlace(fraction=1.0, direction=(-0.1, -1.0, 0), distance=0.25, height=0.07),),
)
PARAMETERS = {'flexibility': 76.5, 'elasticity': 45.0, 'friction': 70.0, 'self_collision': 25.6}
GROUNDS = (('paper', (0.85, 0.80, 0.72)), ('paper', (0.45, 0.46, 0.48)), ('wood', (0.72, 0.55, 0.38)),
           ('wood', (0.33, 0.20, 0.12)), ('cloth', (0.22, 0.25, 0.30)), ('cloth', (0.15, 0.30, 0.22)))
COLOURS = ((0.10, 0.24, 0.55), (0.75, 0.15, 0.10), (0.92, 0.92, 0.90), (0.12, 0.12, 0.14), (0.85, 0.70, 0.12),
           (0.12, 0.45, 0.20), (0.85, 0.42, 0.10), (0.50, 0.50, 0.52), (0.70, 0.58, 0.40))
LEAST_CONTRAST = 0.25  # between a colour and its ground, in the root of linear light
MARGIN = 0.03  # of the picture, where no random film shows the DLO


@dataclass(frozen=True, eq=False)
class Scene:
    """
    What a film shows.

    :param away: (3,) from the DLO to where the hand comes from [m].
    :param arm: direction of the hand's arm [rad].
    :param held: whether the camera is held in the hand.
    """

    look: Look
    actions: tuple[NamedAction, ...]
    camera: Camera
    radius: float
    flexibility: float
    away: Floats
    arm: float
    held: bool


@dataclass(frozen=True, eq=False)
class Moment:
    """
    What is true at one image.

    :param chain: (n, 3) [m].
    :param hand: place (3,) of the finger tips [m]; None: there is none.
    :param closed: whether the hand holds the DLO.
    """

    time: float
    chain: Floats
    hand: Floats | None
    closed: bool


@cache
def scene(number: int) -> Scene:
    """Return what a film shows."""
    if number >= FILMS:
        return next(drawn for drawn in _random(number) if _in_picture(drawn))
    tilt, turn, roll = np.random.default_rng(100 + number).uniform((0.2, -0.3, -0.05), (0.6, 0.3, 0.05))
    actions = ACTIONS[number % len(ACTIONS)]
    return Scene(LOOKS[number % len(LOOKS)], actions + actions[:1],
                 Camera(SIZE, FOCAL, tilt, turn, roll, 0.78, (0.31, 0.0)), RADIUS,
                 float(np.random.default_rng(number).uniform(65.4, 86.2)), AWAY, ARM, number % 5 == 4)


def _random(number: int) -> Iterator[Scene]:
    """Draw what a random film may show."""
    generator = np.random.default_rng(number)
    size = round(SMALL * SIZE[0]), round(SMALL * SIZE[1])
    pairs = [(ground, colour) for ground in GROUNDS for colour in COLOURS
             if np.linalg.norm(np.sqrt(ground[1]) - np.sqrt(colour)) > LEAST_CONTRAST]
    while True:
        (kind, ground), colour = pairs[generator.integers(len(pairs))]
        azimuth, elevation = generator.uniform((-math.pi, 0.6), (math.pi, 1.3))
        look = Look(ground=kind, ground_colour=ground, ground_contrast=generator.uniform(0.03, 0.15),
                    colour=colour, lamp=(azimuth, elevation))
        arm = generator.uniform(-2.6, -0.5)
        away = 0.5 * np.array([math.cos(arm), math.sin(arm), 0.25])
        tilt, turn, roll, distance = generator.uniform((0.1, -0.5, -0.1, 0.78), (0.7, 0.5, 0.1, 0.95))
        place = Camera(size, SMALL * FOCAL, tilt, turn, roll, distance, (0.31, 0.0))
        yield Scene(look, tuple(_random_action(generator) for _ in range(3)), place,
                    generator.uniform(0.0025, 0.006), generator.uniform(55.0, 90.0), away, arm,
                    bool(generator.random() < 0.3))


def _random_action(generator: np.random.Generator) -> NamedAction:
    """Draw an action: half of them at an end."""
    fraction = float(generator.integers(2)) if generator.random() < 0.5 else generator.uniform(0.1, 0.9)
    angle = generator.uniform(-math.pi, math.pi)
    direction, distance = (math.cos(angle), math.sin(angle), 0.0), generator.uniform(0.08, 0.3)
    if generator.random() < 0.5:
        return Drag(fraction=fraction, direction=direction, distance=distance)
    return GraspAndPlace(fraction=fraction, direction=direction, distance=distance,
                         height=generator.uniform(0.04, 0.1))


def _in_picture(drawn: Scene) -> bool:
    """Tell whether a film shows the whole DLO, always."""
    size = np.array(drawn.camera.size)
    points = np.concatenate([moment.chain for moment in events(drawn)[::5]])
    pixels = drawn.camera.project(points)
    return bool(((pixels > MARGIN * size) & (pixels < (1 - MARGIN) * size)).all())


def events(shown: Scene) -> list[Moment]:
    """Return what happens in a film, image by image."""
    points = np.zeros((121, 3))
    points[:, 0], points[:, 2] = np.linspace(0.0, LENGTH, len(points)), shown.radius
    points = _moved(points, Drag(fraction=0.3, direction=(0, -1, 0), distance=0.04), 76.5)[0][-1]
    listed: list[Moment] = []

    def add(chain: Floats, hand: Floats | None, closed: bool) -> None:
        listed.append(Moment(len(listed) / RATE, chain, hand, closed))

    for named in shown.actions:
        for _ in range(round(REST * RATE)):
            add(points, None, False)
        chains, hands, closed = _moved(points, named, shown.flexibility)
        begin, end = hands[0], hands[-1]
        count = round(APPROACH * RATE)
        for share in np.linspace(1.0, 0.0, count):
            add(points, begin + (share ** 1.5) * shown.away, False)
        for chain, hand, holds in zip(chains, hands, closed, strict=True):
            add(chain, hand, holds)
        points = chains[-1]
        for share in np.linspace(0.0, 1.0, count):
            add(points, end + (share ** 1.5) * shown.away, False)
    for _ in range(round(REST * RATE)):
        add(points, None, False)
    return listed


def _moved(points: Floats, named: NamedAction,
           flexibility: float) -> tuple[list[Floats], list[Floats], list[bool]]:
    """Return the chains during an action, where the hand is, and whether it is closed."""
    chain, options = Chain(points), Options.of(FINE)
    action = named.action(chain)
    hand = action.hands[0]
    times = np.arange(1, round((hand.end + SETTLE) * RATE) + 1) / RATE
    simulator = make_simulator(options)
    values = options.space.physical({**PARAMETERS, 'flexibility': flexibility}, LENGTH)
    goals = tuple(Goal(chain, float(time), stable=False) for time in times)
    chains = simulator.simulate(Trial(named.name, chain, (action,), goals), values).chains
    simulator.close()
    places = np.column_stack([np.interp(times, hand.times, axis) for axis in np.asarray(hand.positions).T])
    return list(chains), list(places), [bool(hand.times[0] <= time <= hand.end) for time in times]


def camera(shown: Scene, time: float) -> Camera:
    """Return the camera of a film at a time [s]."""
    place = shown.camera
    if not shown.held:
        return place
    sway = [0.02 * math.sin(time * rate + 2 * k) for k, rate in enumerate((2.3, 3.1, 1.7, 2.0))]
    return replace(place, tilt=place.tilt + sway[0], turn=place.turn + sway[1], roll=place.roll + sway[2],
                   target=(0.31 + sway[3], sway[0] / 2), distance=place.distance + sway[1])
