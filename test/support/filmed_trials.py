# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Films of trials: a rope with known parameters, which a hand with a tag moves beside the printed board."""

from dataclasses import dataclass
import functools

from films import Instant, plain_look, Renderer, Tag
from laid_board import LaidBoard
import numpy as np
from photographs import Camera
from photographs import Hand as Fingers
from scipy.spatial.transform import Rotation

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.vision.tags import QUIET, TAG_CELLS, tag_cells, TAG_SIDE

LENGTH, RADIUS, MASS = 0.6, 0.004, 0.03  # m, m, kg
TRUTH = {'flexibility': 72.3, 'elasticity': 40.0, 'friction': 65.0, 'self_collision': 25.6, 'damping': 50.0}
NODES = 61
RATE = 30.0  # images in a second
WAIT, COME, REST = 1.2, 0.6, 2.6  # s before a hand comes, until it closes, and after it opens
GRIP_TO_TAG = np.array([0.0, -0.012, 0.03])  # m, in the frame of the hand
BOARD = LaidBoard((0.22, -0.33))  # in the middle, where it determines the scale best
CELL = 20  # px of a cell in the picture of a tag


@dataclass(frozen=True)
class Move:
    """
    A movement of a hand.

    :param grip: node that it holds.
    :param way: over the table [m].
    :param lift: height of the grip halfway [m].
    :param turn: about the vertical [deg].
    """

    grip: int
    way: tuple[float, float]
    lift: float = 0.0
    turn: float = 40.0
    seconds: float = 1.6


MOVES = (Move(12, (0.06, 0.18)), Move(55, (-0.12, 0.06), turn=-30.0))


@dataclass(frozen=True, eq=False)
class FilmedTrials:
    """
    What happens in a film, image by image.

    :param times: (n,) [s], and `curves`, (n, NODES, 3) [m].
    :param grips: (n, 3) where the hand's fingers meet [m], and `turns`, (n,) about the vertical [deg].
    :param holds: from when to when the hand holds the DLO, and which node.
    """

    times: np.ndarray
    curves: np.ndarray
    grips: np.ndarray
    turns: np.ndarray
    holds: tuple[tuple[float, float, int], ...]

    def tag(self, k):
        """Return the middle (3,) [m] and the rotation (3, 3) of the tag in image k."""
        rotation = Rotation.from_euler('ZX', [self.turns[k], -25.0], degrees=True).as_matrix()
        above = Rotation.from_euler('z', self.turns[k], degrees=True).apply(GRIP_TO_TAG)
        return self.grips[k] + above, rotation

    def instant(self, k, camera):
        """Return what image k shows."""
        position, rotation = self.tag(k)
        half = TAG_SIDE / 2 + QUIET
        corners = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        grip = self.grips[k]
        fingers = Fingers((grip[0], grip[1]), np.deg2rad(self.turns[k] - 90), max(grip[2], 0.012))
        return Instant(camera, self.curves[k], (fingers,),
                       (Tag(tag_picture(0), corners @ rotation.T + position),))

    def images(self, camera, exposed=1, seed=0, **look):
        """Yield the images; `camera` is one, or a function of the time; `exposed` instants make an image."""
        renderer = Renderer(plain_look(sheets=(BOARD.sheet,), **look), RADIUS, seed=seed)
        for k in range(len(self.times)):
            seen_from = camera(self.times[k]) if callable(camera) else camera
            rows = np.clip(np.arange(k, k + exposed), 0, len(self.times) - 1)
            yield renderer.image([self.instant(row, seen_from) for row in rows])


@functools.cache
def tag_picture(number):
    """Return the picture of a tag with its margin."""
    cells = np.kron(tag_cells(number), np.ones((CELL, CELL), np.uint8))
    return np.pad(cells, round(QUIET / TAG_SIDE * TAG_CELLS * CELL), constant_values=255)


def film_camera(size=(1920, 1080)):
    """Return a camera that stands in front of the table."""
    return Camera(size, 1500.0 * size[0] / 1920, tilt=0.45, distance=0.95, target=(0.27, 0.0))


def filmed_trials(moves=MOVES, rate=RATE, truth=None, seed=0):
    """Return a film of a rope that is moved several times."""
    generator = np.random.default_rng(seed)
    along = np.linspace(0.0, 1.0, NODES) * LENGTH
    bend = generator.uniform(-0.03, 0.03)
    points = np.column_stack([-0.02 + along, bend * np.sin(7 * along), np.full(NODES, RADIUS)])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points[:, 0] = -0.02 + (points[:, 0] + 0.02) * LENGTH / steps.sum()
    curves, grips, turns, holds, now = [], [], [], [], 0
    heading = 0.0
    for move in moves:
        closes, opens = WAIT + COME + 0.2, WAIT + COME + 0.2 + move.seconds
        times = np.arange(round((opens + REST) * rate)) / rate
        knots = np.linspace(0.0, 1.0, 33)
        done = 3 * knots**2 - 2 * knots**3
        path = points[move.grip] + np.column_stack([done * move.way[0], done * move.way[1],
                                                    move.lift * np.sin(np.pi * done)])
        hand = Hand('hand_1', (move.grip,), knots * move.seconds, path)
        instants = times[times > closes] - closes
        goals = tuple(Goal(Chain(points), float(t), stable=False, held_by=('hand_1',) if t < hand.end else ())
                      for t in instants)
        physical = ParameterSpace(fixed=truth or TRUTH, mass=MASS).physical({}, LENGTH)
        trial = Trial('take', Chain(points), (Action((hand,)),), goals)
        chains = np.asarray(CompiledSimulator().simulate(trial, physical).chains)
        curves += [points] * int((times <= closes).sum()) + list(chains)
        place = hand.positions_at(times - closes)
        share = np.clip((times - WAIT) / COME, 0, 1), np.clip((times - opens - 0.3) / COME, 0, 1)
        away = 1 - (3 * share[0]**2 - 2 * share[0]**3) + (3 * share[1]**2 - 2 * share[1]**3)
        grips += list(place + away[:, None] * np.array([0.1, -0.3, 0.12]))
        at = np.clip((times - closes) / move.seconds, 0, 1)
        turned = heading + move.turn * (3 * at**2 - 2 * at**3)
        turns += list(turned)
        heading = turned[-1]
        holds.append((now / rate + closes, now / rate + opens, move.grip))
        now += len(times)
        points = chains[-1]
    return FilmedTrials(np.arange(now) / rate, np.array(curves), np.array(grips), np.array(turns),
                        tuple(holds))


def clicks(film, camera, count=4, seed=0):
    """Return the rough clicks of a person in the first image, (count, 2) [px]."""
    generator = np.random.default_rng(seed)
    rows = np.linspace(0, NODES - 1, count).astype(int)
    return camera.project(film.curves[0][rows]) + generator.normal(0, 1.0, (count, 2))
