# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Random scenes for photographs: DLOs on a table, their looks, cameras, and the clicks of a person."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from photographs import Camera, Hand, Look
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

FINE = 0.001  # m between the points of a curve
NEAR_CROSSING = 1.6  # diameters, standard deviation of the rise over another strand

#: DLO and ground, as pairs that differ in brightness or in colour
COLOURS = (
    ((0.75, 0.13, 0.10), (0.80, 0.80, 0.78)), ((0.92, 0.92, 0.90), (0.22, 0.25, 0.30)),
    ((0.10, 0.10, 0.11), (0.75, 0.60, 0.42)), ((0.95, 0.85, 0.20), (0.35, 0.38, 0.42)),
    ((0.10, 0.25, 0.70), (0.85, 0.80, 0.72)), ((0.95, 0.95, 0.93), (0.60, 0.42, 0.27)),
    ((0.15, 0.45, 0.20), (0.82, 0.78, 0.70)), ((0.85, 0.40, 0.08), (0.25, 0.35, 0.50)),
    ((0.12, 0.12, 0.14), (0.86, 0.86, 0.88)), ((0.75, 0.65, 0.45), (0.20, 0.30, 0.24)))


@dataclass(frozen=True)
class Scene:
    """
    All that determines a photograph, and the clicks of somebody who looks at it.

    :param curve: (n, 3) [m].
    :param clicks: (k, 2) [px].
    """

    name: str
    curve: np.ndarray
    radius: float
    camera: Camera
    look: Look
    clicks: np.ndarray
    seed: int


def lifted(flat, radius):
    """Return a curve (n, 3) on the table; where it crosses itself, the later part lies above."""
    arc = np.arange(len(flat)) * FINE
    heights = np.full(len(flat), radius)
    pairs = cKDTree(flat).query_pairs(1.2 * FINE, output_type='ndarray')
    far = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) * FINE > 8 * radius + 0.01]
    for k in np.unique(far.max(axis=1)) if len(far) else ():
        rise = 2.05 * radius * np.exp(-0.5 * ((arc - arc[k]) / (NEAR_CROSSING * 2 * radius)) ** 2)
        heights = np.maximum(heights, radius + rise)
    return np.column_stack([flat, heights])


def lying(generator, length, radius, loops=0):
    """Draw a DLO (n, 3) [m] with smooth bends, that crosses itself only if it has loops."""
    count = round(length / FINE) + 1
    arc = np.arange(count) * FINE
    while True:
        bends = generator.integers(1, 5)
        curvature = gaussian_filter1d(generator.standard_normal(count), count / (3.0 * bends))
        curvature *= generator.uniform(0.6, 1.4) * 2.2 * (bends + 1) / length / np.abs(curvature).max()
        for _ in range(loops):
            width = generator.uniform(0.12, 0.2) * length
            middle = generator.uniform(0.4, 0.6) * length
            turn = generator.choice([-1, 1]) * generator.uniform(0.75, 1.05) * 2 * np.pi
            bump = np.exp(-0.5 * ((arc - middle) / width) ** 4)
            curvature = 0.35 * curvature * (1 - bump) + turn * bump / (bump.sum() * FINE)
        if np.abs(curvature).max() > 0.4 / radius:
            continue
        # Nothing bends a free end.
        curvature *= np.clip((np.minimum(arc, length - arc) - radius) / (0.02 + 2 * radius), 0, 1)
        angle = np.cumsum(curvature) * FINE
        flat = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]), axis=0) * FINE
        flat -= (flat.max(axis=0) + flat.min(axis=0)) / 2
        # Strands that run beside each other at a small angle are another matter than crossings.
        pairs = 3 * cKDTree(flat[::3]).query_pairs(3 * radius + 3 * FINE, output_type='ndarray')
        far = pairs[(pairs[:, 1] - pairs[:, 0]) * FINE > 12 * radius + 0.01]
        if not loops and not len(far):
            return lifted(flat, radius)
        if loops and len(far):
            across = np.abs(np.sin(angle[far[:, 0]] - angle[far[:, 1]]))
            ends = np.minimum(far[:, 0], count - far[:, 1]) * FINE
            if across.min() > 0.5 and ends.min() > 0.03:
                return lifted(flat, radius)


def bends(curve, limit=0.5):
    """Return the indices of the bends of a curve: where its curvature is largest between changes of sign."""
    flat = gaussian_filter1d(curve[:, :2], 8, axis=0)
    angle = np.unwrap(np.arctan2(*np.diff(flat, axis=0).T[::-1]))
    curvature = gaussian_filter1d(np.diff(angle), 8)
    edges = [0, *np.nonzero(np.diff(np.sign(curvature)))[0], len(curvature)]
    indices = []
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        turned = np.abs(curvature[first:last].sum())
        # A loop is as many bends as it has quarter turns and a half.
        parts = max(1, round(turned / (0.75 * np.pi))) if turned > limit else 0
        share = np.abs(np.cumsum(curvature[first:last])) / max(turned, 1e-9)
        indices += [first + int(np.searchsorted(share, (k + 0.5) / parts)) for k in range(parts)]
    return indices


def clicks(generator, scene_camera, curve, off):
    """Return what a person clicks on: both ends and each bend, 2 to 8 clicks, `off` pixels beside."""
    at = [0, *bends(curve), len(curve) - 1]
    while len(at) > 8:
        gaps = np.array(at[2:]) - np.array(at[:-2])
        at.pop(1 + int(np.argmin(gaps)))
    pixels = scene_camera.project(curve[at])
    angle = generator.uniform(0, 2 * np.pi, len(at))
    return pixels + off * np.column_stack([np.cos(angle), np.sin(angle)])


def scene(seed, size=(4000, 3000), length=0.6, off=10.0, **fixed):
    """
    Draw a scene.

    :param size: of the photograph [px].
    :param off: distance of each click from the DLO's middle line [px].
    :param fixed: radius, loops, tilt, hand (0 or 1), or fields of Look.
    """
    generator = np.random.default_rng(seed)
    radius = fixed.pop('radius', 0.0015 * (0.010 / 0.0015) ** generator.uniform())
    loops = fixed.pop('loops', int(generator.uniform() < 0.3))
    curve = lying(generator, length, radius, loops)
    colour, ground_colour = COLOURS[generator.integers(len(COLOURS))]
    choice = {
        'ground': str(generator.choice(['plain', 'wood', 'cloth', 'checked'])), 'colour': colour,
        'ground_colour': ground_colour, 'ground_contrast': generator.uniform(0.06, 0.22),
        'pattern': str(generator.choice(['plain', 'plain', 'striped', 'braided'])),
        'second_colour': tuple(np.clip(np.array(colour) * generator.uniform(0.5, 0.8)
                                       + generator.uniform(0, 0.2), 0, 1)),
        'pitch': generator.uniform(1.5, 5) * 2 * radius, 'highlight': generator.uniform(0, 1),
        'lamp': (generator.uniform(-np.pi, np.pi), generator.uniform(0.6, 1.3)),
        'shadow': generator.uniform(0.3, 0.7), 'noise': generator.uniform(1, 5),
        'blur': generator.uniform(0.5, 1.8)}
    tilt = fixed.pop('tilt', math.radians(generator.uniform(0, 40)))
    k1 = generator.uniform(-0.15, 0.12)
    lens = {'focal_length': size[0] * generator.uniform(0.68, 0.85), 'tilt': tilt,
            'turn': generator.uniform(-np.pi, np.pi), 'roll': generator.uniform(-0.2, 0.2), 'size': size,
            'distortion': (k1, -0.3 * k1, *generator.uniform(-0.002, 0.002, 2), 0.0)}
    hand = fixed.pop('hand', int(generator.uniform() < 0.25))
    camera = _framed(curve, lens, generator.uniform(0.5, 0.92))
    clicked = clicks(generator, camera, curve, off)
    if hand:
        choice['hands'] = (_hand(generator, camera, curve, radius, clicked),)
    look = Look(**{**choice, **fixed})
    name = (f'{2000 * radius:.1f} mm {look.pattern} on {look.ground}, {math.degrees(tilt):.0f} degrees'
            f'{", loop" * loops}{", hand" * bool(look.hands)}')
    return Scene(name, curve, radius, camera, look, clicked, seed)


def _hand(generator, camera, curve, radius, clicked):
    """Return a hand over the DLO or beside it; nobody clicks on a hand."""
    while True:
        index = int(generator.uniform(0.15, 0.85) * len(curve))
        # The arm comes across the DLO, mostly from outside.
        place, along = curve[index, :2], curve[index + 5, :2] - curve[index - 5, :2]
        across = np.array([-along[1], along[0]]) * np.sign(place @ [-along[1], along[0]])
        direction = math.atan2(across[1], across[0]) + generator.uniform(-0.5, 0.5)
        away = np.array([math.cos(direction), math.sin(direction)])
        if generator.uniform() < 0.5:
            place = place + (3 * radius + 0.02) * away
        scale = camera.size[0] / 4000
        covered = cKDTree(camera.project([[*(place + t * away), 0.03] for t in np.arange(0, 0.6, 0.01)]))
        # A hand is about 8 cm wide.
        limit = 0.055 * camera.focal_length / camera.distance
        if (covered.query(clicked)[0] > limit + 30 * scale).all():
            hidden = (covered.query(camera.project(curve))[0] < limit).mean()
            if hidden < 0.25:
                return Hand(tuple(place), direction, max(0.012, radius * 2 + 0.006))
        if generator.uniform() < 0.02:
            return Hand((place + 0.1 * away).tolist(), direction)


def _framed(curve, lens, share):
    """Return the camera at the distance at which the DLO fills a share of the picture."""
    low, high = 0.2, 3.0
    for _ in range(30):
        distance = (low + high) / 2
        camera = Camera(distance=distance, **lens)
        pixels = camera.project(curve)
        limit = np.array(lens['size'])
        fits = (np.abs(pixels - limit / 2) < share * limit / 2).all()
        low, high = (low, distance) if fits else (distance, high)
    return Camera(distance=high, **lens)


def distances(scene, pixels, count=21):
    """
    Return how far a trace is from the truth [m].

    Pixels are mapped to the table with the true camera, each at the height that the axis has there.

    :param pixels: (n, 2), from end to end.
    :return: distances of `count` points, evenly along the trace, from those evenly along the DLO as it is
        seen from above; and the distances (n,) of all pixels from the DLO.
    """
    seen = scene.camera.project(scene.curve)
    share, along = _shares(pixels), _shares(seen)
    flat = scene.camera.on_plane(pixels, np.interp(share, along, scene.curve[:, 2]))[:, :2]
    truth = scene.curve[:, :2]
    at = np.linspace(0, 1, count)
    evenly = [np.column_stack([np.interp(at, _shares(line), column) for column in line.T])
              for line in (flat, truth)]
    # A pixel belongs to the strand near its own place along the line, also at crossings.
    fine = np.linspace(0, 1, 4000)
    strand = np.column_stack([np.interp(fine, along, column) for column in truth.T])
    near = np.round(share[:, None] * (len(fine) - 1)).astype(int) + np.arange(-240, 241)
    near = np.clip(near, 0, len(fine) - 1)
    off = np.linalg.norm(flat[:, None] - strand[near], axis=2).min(axis=1)
    return np.linalg.norm(evenly[0] - evenly[1], axis=1), off


def _shares(line):
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    return arc / arc[-1]
