# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Ropes that touch bodies: around a cylinder with weights at both ends, and dragged around pegs."""

import numpy as np
from scipy.integrate import solve_ivp

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation import core
from dlo_calibration.simulation.scene import core_scene, NO_TRIANGLES, Obstacle

STEP = 0.003
PHYSICAL = {'flexibility': 1e-4, 'elasticity': 2000.0, 'friction': 0.4, 'self_collision': 0.004, 'mass': 0.03,
            'damping': 1.0, 'internal_damping': 1e-3}
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
ALONG_Y = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
NO_TABLE = -1e6


def obstacle(shape, sizes, position=(0, 0, 0), turn=UPRIGHT, friction=1.0, triangles=NO_TRIANGLES):
    return Obstacle(shape, np.array(sizes, float), np.array(position, float), np.array(turn, float), friction,
                    np.array(triangles, float))


def rope_at(points, physical=PHYSICAL, obstacles=(), *, places=None, velocities=None, features=None):
    """Return a rope in the core whose segments have their lengths at rest, unless `places` says otherwise."""
    points = np.asarray(points, float)
    if places is None:
        places = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    velocities = np.zeros_like(points) if velocities is None else velocities
    return core.Rope(core.Start(places, points, velocities, features), physical, STEP, NO_TABLE,
                     (0, 0, -GRAVITY), core_scene(obstacles))


def line(start, direction, length, count):
    return np.asarray(start, float) + np.linspace(0, length, count)[:, None] * np.asarray(direction, float)


def box_mesh(edges):
    """Return the 12 triangles of a box."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(edges) / 2
    faces = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6),
             (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    return corners[np.array(faces)]


LIGHT, LEG, DENSITY = 0.1, 0.15, 0.03  # kg at the lighter end, m, kg/m


def capstan_tensions(mu, angle, radius):
    """
    Return the tension [N] along the arc of a heavy rope that begins to slide, by Euler's equation.

    dT/da = mu (T + w R cos b) - w R sin b, with w the weight per length and b the angle from the top.
    """
    weight = DENSITY * GRAVITY * radius
    tension = (LIGHT + DENSITY * LEG) * GRAVITY

    def slope(a, t):
        b = a - np.pi / 2  # from the top of the cylinder
        return mu * (t + weight * np.cos(b)) - weight * np.sin(b)

    return solve_ivp(slope, (0, angle), [tension], rtol=1e-8, dense_output=True).sol


def sliding_speed(share, angle, radius, nodes, mu=0.2):
    """
    Return how fast [m/s] a rope with weights at its ends slides around a cylinder.

    :param share: the heavier weight is that with which a rope begins to slide whose friction is
        `share` times `mu`.
    """
    heavier = capstan_tensions(share * mu, angle, radius + PHYSICAL['self_collision'])(angle)[0] / GRAVITY
    heavier -= DENSITY * LEG
    thickness = PHYSICAL['self_collision']
    turn = radius + thickness
    along = np.linspace(0, angle * turn + 2 * LEG, nodes)
    arc = np.clip((along - LEG) / turn, 0, angle)
    points = np.stack([-turn * np.cos(arc), 2.5 * thickness * arc / (2 * np.pi), turn * np.sin(arc)], axis=1)
    points[:, 2] -= np.maximum(LEG - along, 0) + np.maximum(along - LEG - angle * turn, 0)
    tensions = capstan_tensions(mu, angle, turn)(arc)[0]
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    strain = (tensions[1:] + tensions[:-1]) / 2 / PHYSICAL['elasticity']
    weights = np.zeros(nodes)
    weights[0], weights[-1] = 1.0, heavier / LIGHT
    rope = rope_at(points, {**PHYSICAL, 'flexibility': 1e-6, 'friction': mu, 'mass': DENSITY * along[-1],
                            'marker_mass': LIGHT, 'damping': 5.0, 'internal_damping': 0.01},
                   [obstacle('cylinder', (2.0, radius), turn=ALONG_Y)],
                   places=np.append(0.0, np.cumsum(lengths / (1 + strain))), features=weights)
    heights = []
    for _ in range(int(1.0 / STEP)):
        assert rope.step()
        heights.append(rope.points[-1, 2])
        if rope.points[0, 2] > -0.05:  # the lighter end is almost on the cylinder
            break
    half = len(heights) // 2
    return (heights[half] - heights[-1]) / (len(heights) - 1 - half) / STEP


def dragged(way, duration, height=PHYSICAL['self_collision']):
    """Return a trial: one end of a rope that lies along x goes a way [m] and is released."""
    points = line((0, 0, height), (1, 0, 0), 0.6, 41)
    way = np.array(way, float)
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    hand = Hand('hand', (40,), along / along[-1] * duration, way)
    goals = [Goal(Chain(points), share * duration, stable=False, held_by=('hand',)) for share in (0.5, 1.0)]
    return Trial('drag', Chain(points), (Action((hand,)),), (*goals, Goal(Chain(points), duration + 3)))


def pegs(*places, radius=0.01):
    return [obstacle('cylinder', (0.1, radius), (x, y, 0.05)) for x, y in places]


AROUND_ONE = dragged([(0.6, 0, 0.004), (0.55, 0.2, 0.02), (0.3, 0.25, 0.02), (0.1, 0.15, 0.02)], 3.0)
AROUND_TWO = dragged([(0.6, 0, 0.004), (0.55, 0.15, 0.02), (0.4, 0.15, 0.02), (0.28, -0.1, 0.02)], 3.0)
