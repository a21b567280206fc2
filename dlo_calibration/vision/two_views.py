# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Two views: the axis of a lifted DLO from two photographs of the same moment.

Each point of a line in a photograph is a ray in space.  Dynamic programming assigns the rays of one line
to those of the other, in order, so that they nearly meet.  A smooth curve is then fitted to both lines:
where the DLO runs along the rays' common plane, only its smoothness determines its place.
"""

from __future__ import annotations

import math
from typing import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.axis import Axis
from dlo_calibration.vision.middle_line import along_line, arc_lengths
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Trace

STATIONS = 120  # of each line, for the assignment
KNOTS = 24  # of the curve
SAMPLES = 240  # of the curve, that are compared with the lines
ITERATIONS = 12  # of the fit
LEAST_ANGLE = math.radians(20)  # between the two views; nearer ones make heights several times less exact
EXACT = 3e-4  # m, deviation of a line
SMOOTH = 4e-3  # m, third difference of neighbouring knots, as of a bend whose radius changes within 0.1 m
BELOW = 8e-3  # m below the table; deeper places are not the DLO's
FARTHEST = 4e-3  # m between the curve and the lines (root mean square), at most
REMEDY = 'check both lines and scales, and that the DLO did not move between the photographs'
ENDS = 0.012  # m between the rays to an end of the DLO, at most


def axis_of_two_views(first: Trace, first_scale: Scale, second: Trace, second_scale: Scale,
                      diameter: float) -> Axis:
    """
    Return the axis of a DLO in space, from the first line's beginning to its end.

    The second line may have the other direction.

    :param first: its middle line in one photograph; `second`: in the other one.
    :param diameter: of the DLO [m].
    :raises InputError: where the two photographs do not determine it.
    """
    scales = first_scale, second_scale
    lines = [along_line(trace.pixels, along, np.linspace(0.0, along[-1], SAMPLES))
             for trace, along in ((first, arc_lengths(first.pixels)), (second, arc_lengths(second.pixels)))]
    _check_views(lines, scales)
    knots, cost = _assigned(lines[0], lines[1], scales)
    reversed_knots, reversed_cost = _assigned(lines[0], lines[1][::-1], scales)
    if reversed_cost < cost:
        knots, lines[1] = reversed_knots, lines[1][::-1]
    _check_ends(lines, scales)
    points, deviation = _fitted(knots, lines, scales)
    if deviation > FARTHEST:
        raise InputError('second photograph', f'a line that misses the other by {1000 * deviation:.0f} mm',
                         f'at most {1000 * FARTHEST:.0f} mm', REMEDY)
    lowest = float(points[:, 2].min())
    if lowest < -BELOW:
        raise InputError('second photograph', f'a line that puts the DLO {-1000 * lowest:.0f} mm below the '
                         'table', 'a DLO on or above it', REMEDY)
    points[:, 2] = np.maximum(points[:, 2], diameter / 2)  # it lies on the table, not in it
    places = np.linspace(0.0, 1.0, len(points))
    sure = np.interp(places, np.linspace(0.0, 1.0, len(first.sure)), first.sure) > 0.5
    return Axis(points, sure, np.zeros((0, 2)), diameter)


def _check_views(lines: Sequence[Floats], scales: Sequence[Scale]) -> None:
    """Refuse two photographs from nearly the same direction."""
    middle = scales[0].to_table(lines[0].mean(axis=0)[None])[0]
    sights = [middle - scale.camera for scale in scales]
    cosine = abs(sights[0] @ sights[1]) / np.prod([np.linalg.norm(sight) for sight in sights])
    angle = math.acos(min(float(cosine), 1.0))
    if angle < LEAST_ANGLE:
        raise InputError('second photograph', f'a view {math.degrees(angle):.0f} degrees from the first one',
                         f'at least {math.degrees(LEAST_ANGLE):.0f} degrees, better 60',
                         'take it from the side')


def _check_ends(lines: Sequence[Floats], scales: Sequence[Scale]) -> None:
    """Refuse lines that end at different places of the DLO."""
    for end, name in ((0, 'first'), (-1, 'last')):
        (place,), (gap,) = _meeting(*(_rays(line[[end]], scale) for line, scale in zip(
            lines, scales, strict=True)))
        if gap > ENDS:
            raise InputError('second photograph', f'a line whose {name} end is {1000 * gap:.0f} mm away from '
                             'the line of sight of the other photograph', f'at most {1000 * ENDS:.0f} mm',
                             'click both ends of the DLO in both photographs, and check the scales')


def _rays(pixels: Floats, scale: Scale) -> tuple[Floats, Floats]:
    """Return the camera's place (3,) [m] and the unit directions (n, 3) that pixels (n, 2) show."""
    camera = scale.camera
    ideal = scale.lens.undistorted(pixels)
    seen = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(scale.lens.matrix).T
    directions = seen @ scale.rotation
    return camera, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _meeting(rays: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """
    Return where rays meet: the middles (..., 3) between their nearest points, and the gaps there (...) [m].

    :param rays: a camera's place (3,) and directions (..., 3), likewise `other`; they are broadcast.
    """
    (camera, u), (camera_2, v) = rays, other
    between = camera_2 - camera
    cosine = (u * v).sum(axis=-1)
    sine = np.maximum(1.0 - cosine**2, 1e-9)
    a, b = u @ between, v @ between
    near, far = (a - cosine * b) / sine, (cosine * a - b) / sine
    first, second = camera + near[..., None] * u, camera_2 + far[..., None] * v
    gaps = np.linalg.norm(first - second, axis=-1)
    gaps = np.where((near > 0) & (far > 0), gaps, np.inf)
    return (first + second) / 2, gaps


def _assigned(first: Floats, second: Floats, scales: Sequence[Scale]) -> tuple[Floats, float]:
    """Return points (KNOTS, 3) [m] where the rays of two lines (n, 2) meet best, in order, and their cost."""
    chosen = np.linspace(0, len(first) - 1, STATIONS).round().astype(int)
    rays = [_rays(line[chosen], scale) for line, scale in zip((first, second), scales, strict=True)]
    points, gaps = _meeting((rays[0][0], rays[0][1][:, None]), (rays[1][0], rays[1][1][None, :]))
    cost = np.minimum(gaps, 1.0)**2 + np.where(points[..., 2] < -BELOW, 0.01, 0.0)
    total, step = np.full(cost.shape, np.inf), np.zeros(cost.shape, np.int8)
    for i in range(STATIONS):
        for j in range(STATIONS):
            best, way = (0.0, 0) if i == j == 0 else (np.inf, 0)
            # A diagonal step counts twice: it covers as much of the lines as two others.
            for k, (di, dj, weight) in enumerate(((1, 1, 2.0), (1, 0, 1.0), (0, 1, 1.0))):
                if i >= di and j >= dj and i + j > 0 and total[i - di, j - dj] + weight * cost[i, j] < best:
                    best, way = total[i - di, j - dj] + weight * cost[i, j], k
            total[i, j], step[i, j] = best, way
    i = j = STATIONS - 1
    path = [points[i, j]]
    while i or j:
        di, dj = ((1, 1), (1, 0), (0, 1))[step[i, j]]
        i, j = i - di, j - dj
        path.append(points[i, j])
    way_points = np.array(path[::-1])
    places = np.linspace(0, len(way_points) - 1, KNOTS)
    return along_line(way_points, np.arange(len(way_points), dtype=float), places), float(total[-1, -1])


def _fitted(knots: Floats, lines: Sequence[Floats],
            scales: Sequence[Scale]) -> tuple[Floats, float]:
    """
    Return the curve that both photographs show as lines (n, 2).

    Gauss-Newton with the nearest points of the lines; third differences of the knots are penalised.

    :returns: (SAMPLES, 3) [m], and its deviation from the lines (root mean square) [m].
    """
    weights = CubicSpline(np.linspace(0.0, 1.0, KNOTS), np.eye(KNOTS))(np.linspace(0.0, 1.0, SAMPLES))
    rough = np.kron(np.diff(np.eye(KNOTS), 3, axis=0), np.eye(3)) / SMOOTH
    trees = [cKDTree(line) for line in lines]
    deviation = math.inf
    for _ in range(ITERATIONS):
        curve = weights @ knots
        rows, wanted, missed = [rough], [-rough @ knots.ravel()], []
        for line, scale, tree in zip(lines, scales, trees, strict=True):
            slopes, offsets, (end_slopes, gaps) = _offsets(curve, line, scale, tree)
            rows.append(np.einsum('sc,sk->skc', slopes, weights).reshape(SAMPLES, -1) / EXACT)
            wanted.append(-offsets / EXACT)
            missed.append(offsets)
            rows.append(np.einsum('eac,ek->eakc', end_slopes, weights[[0, -1]]).reshape(4, -1) / EXACT)
            wanted.append(-gaps.ravel() / EXACT)
        change = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)[0]
        knots = knots + change.reshape(-1, 3)
        deviation = float(np.sqrt(np.square(missed).mean()))
        if np.abs(change).max() < 1e-6:
            break
    return weights @ knots, deviation


def _offsets(curve: Floats, line: Floats, scale: Scale,
             tree: cKDTree) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """
    Return the offsets of a curve (s, 3) [m] from a line (n, 2) [px] of a photograph.

    :returns: the slopes (s, 3) of the offsets, the offsets (s,) [m] across the line; and for both ends the
        slopes (2, 2, 3) and the offsets (2, 2) [m] in both directions of the picture.
    """
    step = 1e-5  # m
    pixels = scale.to_pixels(curve)
    if not np.isfinite(pixels).all():
        raise InputError('second photograph', 'a DLO behind a camera', 'one in both pictures',
                         REMEDY)
    moved = np.stack([scale.to_pixels(curve + step * axis) - pixels for axis in np.eye(3)], axis=2) / step
    size = np.sqrt(np.square(moved).sum(axis=(1, 2)) / 2)[:, None]  # px per metre
    nearest = tree.query(pixels)[1]
    tangents = np.gradient(line, axis=0)[nearest]
    across = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9) * size
    slopes = np.einsum('sp,spc->sc', across, moved)
    ends = [0, -1]
    return slopes, (across * (pixels - line[nearest])).sum(axis=1), (
        moved[ends] / size[ends][:, :, None], (pixels[ends] - line[ends]) / size[ends])
