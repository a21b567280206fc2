# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Twist: the forces of a DLO that two clamps keep from turning about its axis.

A DLO has next to no inertia about its axis, so that twist is the same all along,
between two clamps, whenever its stiffness is; the energy is ``c / 2 angle^2`` (Bergou et al., Discrete
Elastic Rods, 2008, 4.2.2).  The angle is that from a frame carried from the first clamp to the
second along the DLO without twist to the frame that the second clamp holds.  It is
zero when both are closed.  How a clamp turns about the DLO's axis is not known, only its
direction: it turns by the smallest rotation from that when it closed.

The forces are the exact slope: a torque of the same size about every joint, of
which the segments pass on as a couple what is across them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.natural import frame_along, HAIRPIN

#: columns of a span: its first and last segment, torque per angle [N m], angle, whether it has begun;
#: then tangent and direction when it began, of the first segment and of the last
FIRST, LAST, STIFFNESS, ANGLE, BEGUN, START, END, COLUMNS = 0, 1, 2, 3, 4, 5, 11, 17


def spans_between(rigid: NDArray[np.bool_], compliances: Floats, before: Floats) -> Floats:
    """
    Return the parts of a DLO between two clamps, (s, COLUMNS).

    :param rigid: (N - 1,) segments that are held.
    :param compliances: (N - 2,) [1/(N m)] of each inner node against twist.
    :param before: (r, COLUMNS) those until now; what is still between the same clamps stays twisted.
    """
    held = np.flatnonzero(rigid)
    pairs = [(a, b) for a, b in zip(held[:-1], held[1:], strict=True) if b > a + 1]
    spans = np.zeros((len(pairs), COLUMNS))
    for span, (a, b) in zip(spans, pairs, strict=True):
        span[:STIFFNESS + 1] = a, b, 1 / compliances[a:b].sum()
        for old in before:
            if (old[:STIFFNESS] == span[:STIFFNESS]).all():
                span[ANGLE:] = old[ANGLE:]
    return spans


def twist_forces(segments: Floats, lengths: Floats, spans: Floats) -> Floats:
    """
    Return the forces on the nodes, (N, 3) [N].

    :param segments: (N - 1, 3) [m] from node to node.
    :param lengths: (N - 1,) [m] of them.
    :param spans: as from `spans_between`; where they are, and their angle, are kept in them.
    """
    tangents = segments / lengths[:, None]
    torques = np.zeros_like(segments)
    for span in spans:
        a, b = int(span[FIRST]), int(span[LAST])
        part = tangents[a:b + 1]
        frame = frame_along(part)
        if not span[BEGUN]:
            span[BEGUN] = 1
            span[START:END] = *part[0], *frame[0]
            span[END:COLUMNS] = *part[-1], *frame[-1]
        here = _turned(span[START:END], part[0])
        there = _turned(span[END:COLUMNS], part[-1])
        angle = _angle(frame[-1], there, part[-1]) - _angle(frame[0], here, part[0])
        angle += 2 * math.pi * round((span[ANGLE] - angle) / (2 * math.pi))
        span[ANGLE] = angle
        both = part[:-1] + part[1:]
        joints = span[STIFFNESS] * angle * both / np.maximum(
            np.einsum('ij,ij->i', both, both) / 2, 2 * HAIRPIN)[:, None]
        torques[a + 1:b + 1] -= joints
        torques[a:b] += joints
    couples = np.cross(torques, tangents) / lengths[:, None]
    forces = np.zeros((len(segments) + 1, 3))
    forces[1:] += couples
    forces[:-1] -= couples
    return forces


def _turned(begun: Floats, tangent: Floats) -> Floats:
    """Turn the direction of a clamp, (6,) with its tangent, by the smallest rotation to a (3,) tangent."""
    before, direction = begun[:3], begun[3:]
    share = float(tangent @ direction) / max(1 + float(tangent @ before), 2 * HAIRPIN)
    turned: Floats = direction - share * (tangent + before)
    return turned


def _angle(first: Floats, second: Floats, tangent: Floats) -> float:
    """Return the angle about the tangent from one direction to another, (3,) each."""
    return math.atan2(np.cross(first, second) @ tangent, first @ second)
