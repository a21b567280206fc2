# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a camera sees of a made-up DLO that a hand with a tag drags or lifts; the truth is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.observation.sightings import HandSightings, Sightings

RATE, COUNT, RADIUS = 30.0, 41, 0.004
CAMERA = np.array([0.3, -0.5, 0.8])
TAG = np.array([0.02, -0.03, 0.05])  # m, from the grip to the tag, in the hand's frame
CLOSES, OPENS = 2.0, 3.6  # s; the hand arrives half a second before, and leaves half a second after


def smooth_step(share):
    """Return how far a smooth movement is at shares of its time."""
    share = np.clip(share, 0.0, 1.0)
    return 3 * share**2 - 2 * share**3


def filmed_hand(place=0.3, lift=0.0, way=(0.1, 0.12), turn=40.0, start=0.0, hidden=2, noise=0.0005, seed=0,
                seconds=7.0, tag=0.001):
    """
    Return sightings of a DLO and of a hand, and where the grip truly is, (n, 3) [m].

    :param place: share of the length at which the hand holds the DLO.
    :param lift: height of the grip halfway [m].
    :param way: of the hand over the table [m].
    :param turn: of the hand about the vertical [deg].
    :param hidden: points to either side of the hand that it hides.
    :param noise: of the points, and `tag` of the tag's positions [m].
    """
    generator = np.random.default_rng(seed)
    times = start + np.arange(0.0, seconds, 1 / RATE)
    since = times - start
    share = np.linspace(0.0, 1.0, COUNT)
    rest = np.column_stack([0.6 * share, 0.05 * np.sin(5 * share), np.full(COUNT, RADIUS)])
    done = smooth_step((since - CLOSES) / (OPENS - CLOSES))
    moved = np.column_stack([done * way[0], done * way[1], lift * np.sin(np.pi * done)])
    weight = np.exp(-((share - place) / 0.2)**2)[:, None]
    points = rest + weight * moved[:, None]
    held = np.stack([np.interp(place, share, axis) for axis in rest.T])
    grip = held + moved
    away = 1 - smooth_step((since - CLOSES + 1.3) / 0.8) + smooth_step((since - OPENS - 0.5) / 0.8)
    grip = grip + away[:, None] * np.array([0.1, -0.1, 0.15])
    turns = Rotation.from_euler('z', (20 + turn * done)[:, None], degrees=True)
    positions = grip + turns.apply(TAG) + generator.normal(0, tag, grip.shape)
    seen = points + generator.normal(0, noise, points.shape)
    rays = seen - CAMERA
    seen = CAMERA + rays * ((RADIUS - CAMERA[2]) / rays[..., 2])[..., None]
    near = np.abs(share[None] - place) * (COUNT - 1) <= hidden
    seen[near & (away < 0.5)[:, None]] = np.nan
    return (Sightings(times, seen, np.tile(CAMERA, (len(times), 1)), RADIUS),
            HandSightings('hand_1', positions, turns.as_quat()), grip)
