# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels that find which segments of a DLO may touch each other, if any."""

from __future__ import annotations

import math

from dlo_calibration.simulation import entries
from dlo_calibration.simulation.compilation import entry, inlined, of_numbers, part
from dlo_calibration.simulation.kernels_contact import closest
from dlo_calibration.simulation.states import Matrix, SelfContact

SKIN = 0.0001, 0.008  # m, least and most; pairs within this gap are checked until nodes may have moved so far
STEPS_AHEAD = 10.0  # between these, the gap is as wide as nodes move in so many steps


@part
def near_pairs(contact: SelfContact, points: Matrix, stretch: float, reach: float) -> int:
    """
    Write to `contact.pairs` the pairs of segments that can touch and whose gap is below `reach` [m].

    From a segment that is far away, the search goes on as far along the DLO as no other can be near.

    :param stretch: largest length of a segment, relative to its rest length.
    :returns: the number of pairs.
    """
    half, middles, pairs, diameter = contact.half, contact.middles, contact.pairs, contact.diameter
    apart, count, segments, longest = contact.apart, 0, len(half), 0.0
    x, y, z = contact.balls[0], contact.balls[1], contact.balls[2]
    for i in range(segments):
        x[i] = (points[i, 0] + points[i + 1, 0]) / 2
        y[i] = (points[i, 1] + points[i + 1, 1]) / 2
        z[i] = (points[i, 2] + points[i + 1, 2]) / 2
        longest = max(longest, half[i])
    longest *= 2 * stretch
    for i in range(segments):
        j = i + 1
        while j < segments and middles[j] - middles[i] - half[j] - half[i] <= apart:
            j += 1
        far = stretch * (half[i] + diameter) + longest / 2 + reach
        while j < segments:
            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            beyond = math.sqrt(dx * dx + dy * dy + dz * dz) - far
            if beyond > 0.0:
                j += 1 + int(min(beyond / longest, float(segments)))  # points may be infinite
                continue
            if closest(points, i, j)[5] <= stretch * diameter + reach:
                pairs[count, 0] = i
                pairs[count, 1] = j
                count += 1
            j += 1
    return count


@entry(entries.start_distances)
def start_distances(contact: SelfContact, points: Matrix) -> None:
    """Set the least distances of pairs at the start, (N, 3) [m] points, so that none is pushed apart."""
    distances, diameter, pairs = contact.distances, contact.diameter, contact.pairs
    distances[:] = diameter
    contact.overlaps[0] = 0
    for k in range(near_pairs(contact, points, 1.0, 0.0)):
        i, j = pairs[k, 0], pairs[k, 1]
        distances[i, j] = min(diameter, closest(points, i, j)[5])
        contact.overlaps[0] = 1
    contact.room[:] = -1.0


@part
def movement(velocities: Matrix, step: float) -> tuple[float, float]:
    """Return upper bounds [m] of how two nodes, and two neighbours, move against each other in a step."""
    middle, before = velocities[len(velocities) // 2], velocities[0]
    away, beside = 0.0, 0.0
    for i in range(len(velocities)):
        here = velocities[i]
        x, y, z = here[0] - middle[0], here[1] - middle[1], here[2] - middle[2]
        away = max(away, x * x + y * y + z * z)
        x, y, z = here[0] - before[0], here[1] - before[1], here[2] - before[2]
        beside = max(beside, x * x + y * y + z * z)
        before = here
    return 2 * step * math.sqrt(away), step * math.sqrt(beside)


@of_numbers
def _least_gap(balls: Matrix, count: int, away: int) -> float:
    """
    Return the least gap [m] between balls, each and the one that is `away` further.

    :param balls: (4, n) [m] centres and radii; the first `count` columns.
    """
    x, y, z, radius = balls[0], balls[1], balls[2], balls[3]
    # Slices, and no branch in the loop: the compiler makes four steps at once of it.
    x_there, y_there, z_there, radius_there = x[away:], y[away:], z[away:], radius[away:]
    least = math.inf
    for i in range(count - away):
        a, b, c = x_there[i] - x[i], y_there[i] - y[i], z_there[i] - z[i]
        least = min(least, math.sqrt(a * a + b * b + c * c) - radius_there[i] - radius[i])
    return least


@part
def _find_room(contact: SelfContact, points: Matrix) -> None:
    """
    Find how far nodes may move until any segments can touch.

    All pairs are checked, which takes less time than a search that branches: near ones along the DLO by balls
    around segments, the others by balls around two segments.
    """
    radius, segments, room = contact.diameter / 2, len(contact.half), contact.room
    single, double = contact.balls[:4], contact.balls[4:]
    for i in range(segments):
        length = 0.0
        for c in range(3):
            single[c, i] = (points[i, c] + points[i + 1, c]) / 2
            length += (points[i + 1, c] - points[i, c])**2
        single[3, i] = radius + math.sqrt(length) / 2
    count = (segments + 1) // 2
    for k in range(count):
        i = 2 * k + 1
        for c in range(3):
            double[c, k] = points[i, c]
        double[3, k] = 2 * max(single[3, i - 1], single[3, min(i, segments - 1)]) - radius
    room[:2] = math.inf
    first = 2 + contact.next_one // 2
    for away in range(contact.next_one, min(2 * first - 1, segments)):
        room[0] = min(room[0], _least_gap(single, segments, away) / (away + 1))
    for away in range(first, count):
        room[1] = min(room[1], _least_gap(double, count, away))


@part
def _look_around(contact: SelfContact, points: Matrix, coming: tuple[float, float]) -> None:
    """Find the pairs of segments that are near, if the DLO may touch itself in a step; see `is_near`."""
    near, room = contact.near, contact.room
    _find_room(contact, points)
    if room[0] >= coming[1] and room[1] >= coming[0]:
        room[2] = -1.0
        near[0] = 0
        if contact.overlaps[0] == 1:
            contact.distances[:] = contact.diameter
            contact.overlaps[0] = 0
        return
    room[2] = coming[0] + min(max(SKIN[0], STEPS_AHEAD * coming[0]), SKIN[1])
    near[0] = near_pairs(contact, points, 1.2, room[2])  # a segment may be stretched by 20 %
    room[:2] = -1.0


@inlined
def is_near(contact: SelfContact, points: Matrix, last: tuple[float, float],
            coming: tuple[float, float]) -> bool:
    """
    Tell whether the DLO may touch itself in a step, and find the pairs of segments that are near.

    :param last: `movement` in the last step.
    :param coming: `movement` in this step without contact.
    """
    room = contact.room
    room[0] -= last[1]
    room[1] -= last[0]
    room[2] -= last[0]
    if room[0] >= coming[1] and room[1] >= coming[0]:
        return False
    if room[2] < coming[0]:
        _look_around(contact, points, coming)
    return bool(contact.near[0] > 0)
