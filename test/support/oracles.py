# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The physics of `kernels` once more, in NumPy, to compare with: short, and not made to be fast."""

import math

import numpy as np

from dlo_calibration.simulation.kernels import (
    FASTEST_PUSH_OUT,
    HAIRPIN,
    HELD,
    ITERATIONS,
    PUSH_OUT,
    ROUNDED,
    SUPPORTED,
    TINY,
    UNSUPPORTED,
    WEDGED,
)


def rod_velocities(rod, points, velocities):
    """Return the (N, 3) [m/s] velocities after one step, by a dense matrix."""
    diagonal, first, second = rod.bending
    bending = np.diag(diagonal)
    for offset, band in ((1, first[:-1]), (2, second[:-2])):
        bending += np.diag(band, offset) + np.diag(band, -offset)
    matrix = np.kron(np.diag(rod.masses * (1 + rod.drag * rod.step)) + rod.implicit * bending, np.eye(3))
    forces = -bending @ points
    for i, segment in enumerate(np.diff(points, axis=0)):
        slack = 1 - rod.rest_lengths[i] / np.linalg.norm(segment)
        tension = rod.stiffness[i] * slack * segment
        forces[i] += tension
        forces[i + 1] -= tension
        across = max(slack, 0) * rod.stiffness[i]
        block = (rod.stiffness[i] - across) * np.outer(segment, segment) / (segment @ segment)
        ends = np.kron([[1, -1], [-1, 1]], block + across * np.eye(3))
        matrix[3 * i:3 * i + 6, 3 * i:3 * i + 6] += rod.implicit * ends
    if len(rod.natural):
        forces += natural_forces(points, rod.natural)
    if len(rod.spans):
        forces += twist_forces(points, rod.spans)
    right = rod.masses[:, None] * velocities + rod.step * forces
    pull = HELD * rod.masses[rod.held, None]
    right[rod.held] += pull * rod.follow
    at = (3 * rod.held[:, None] + np.arange(3)).ravel()
    matrix[at, at] += np.repeat(pull, 3)
    scale = 1 / np.sqrt(np.diag(matrix))  # what is held is 1e12 times as heavy
    found = scale * np.linalg.solve(scale[:, None] * matrix * scale, scale * right.ravel())
    found = found.reshape(-1, 3)
    found[rod.held] = rod.follow
    return found


def _forces(torques, tangents, lengths):
    """Return the (N, 3) [N] forces at the ends of segments that (N - 1, 3) [N m] torques on them are."""
    couples = np.cross(torques, tangents) / lengths[:, None]
    forces = np.zeros((len(lengths) + 1, 3))
    forces[1:] += couples
    forces[:-1] -= couples
    return forces


def natural_forces(points, moments):
    """Return the forces of the natural curvature on the nodes, (N, 3) [N]; moments (N - 2,) [N m]."""
    segments = np.diff(points, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    tangents = segments / lengths[:, None]
    first, second = tangents[:-1], tangents[1:]
    half = np.sqrt(np.maximum((1 + np.einsum('ij,ij->i', first, second)) / 2, HAIRPIN))
    directions = frame_along(tangents)
    sideways = np.cross(tangents, directions)
    bends = np.stack([np.einsum('ij,ij->i', second, axis[:-1]) for axis in (directions, sideways)]) / half
    least = bends @ moments
    least /= np.sqrt(least @ least + (ROUNDED * moments.mean())**2)
    directions = least[0] * directions + least[1] * sideways
    bend = (least @ bends) / (4 * half**2)
    joints = np.cross(second, directions[:-1]) + np.cross(first, directions[1:])
    joints = moments[:, None] * (joints / (2 * half[:, None]) + bend[:, None] * np.cross(first, second))
    torques = np.zeros_like(segments)
    torques[1:] += joints
    torques[:-1] -= joints
    against_twist = np.cumsum(-np.einsum('ij,ij->i', torques, tangents)[:-1]) / half
    axes = (against_twist / (2 * half))[:, None] * (first + second)
    torques[1:] -= axes
    torques[:-1] += axes
    return _forces(torques, tangents, lengths)


def frame_along(tangents):
    """Return (N - 1, 3) unit vectors perpendicular to the tangents that do not twist about them."""
    some = np.cross(tangents, np.eye(3)[np.abs(tangents).argmin(axis=1)])
    some /= np.linalg.norm(some, axis=1, keepdims=True)
    other = np.cross(tangents, some)
    first, second = tangents[:-1], tangents[1:]
    between = np.maximum(1 + np.einsum('ij,ij->i', first, second), 2 * HAIRPIN)
    there = some[:-1] - (np.einsum('ij,ij->i', second, some[:-1]) / between)[:, None] * (first + second)
    turned = np.arctan2(np.einsum('ij,ij->i', there, other[1:]), np.einsum('ij,ij->i', there, some[1:]))
    angles = np.concatenate([[0.0], np.cumsum(turned)])[:, None]
    # The angle from `some` of a vector that goes along without twist grows by what `some` lags behind it.
    return np.cos(angles) * some + np.sin(angles) * other


def twist_forces(points, spans):
    """Return the forces of twist on the nodes, (N, 3) [N]; brings the spans up to date."""
    segments = np.diff(points, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    tangents = segments / lengths[:, None]
    torques = np.zeros_like(segments)
    for span in spans:
        a, b = span['first'], span['last']
        part = tangents[a:b + 1]
        frame = frame_along(part)
        if not span['begun']:
            span['begun'] = 1
            span['start'], span['start_frame'], span['end'], span['end_frame'] = (
                part[0], frame[0], part[-1], frame[-1])
        here = _turned(span['start'], span['start_frame'], part[0])
        there = _turned(span['end'], span['end_frame'], part[-1])
        angle = _angle(frame[-1], there, part[-1]) - _angle(frame[0], here, part[0])
        angle += 2 * math.pi * round((span['angle'] - angle) / (2 * math.pi))
        span['angle'] = angle
        both = part[:-1] + part[1:]
        joints = span['stiffness'] * angle * both / np.maximum(
            np.einsum('ij,ij->i', both, both) / 2, 2 * HAIRPIN)[:, None]
        torques[a + 1:b + 1] -= joints
        torques[a:b] += joints
    return _forces(torques, tangents, lengths)


def _turned(before, direction, tangent):
    """Turn the direction of a clamp by the smallest rotation from its tangent to another, (3,) each."""
    return direction - tangent @ direction / max(1 + tangent @ before, 2 * HAIRPIN) * (tangent + before)


def _angle(first, second, tangent):
    """Return the angle about the tangent from one direction to another, (3,) each."""
    return math.atan2(np.cross(first, second) @ tangent, first @ second)


def kept_apart(contact, points, velocities, inverse_masses, support, step):
    """Return the (N, 3) [m/s] velocities that contacts allow; every pair that may touch is looked at."""
    middles, half = contact.middles, contact.half
    between = middles[None, :] - middles[:, None] - half[None, :] - half[:, None]
    first, second = np.nonzero(between > contact.apart)
    s, t, normal, distance = closest(points, first, second)
    gap = distance - np.maximum(contact.distances[first, second], np.minimum(distance, contact.diameter))
    wanted = np.where(gap > 0, -gap / step, np.minimum(-PUSH_OUT * gap / step, FASTEST_PUSH_OUT))
    nodes = np.stack([first, first + 1, second, second + 1], axis=1)
    weights = np.stack([1 - s, s, -(1 - t), -t], axis=1)
    near = np.einsum('ck,ckj,cj->c', weights, velocities[nodes], normal) < wanted
    nodes, weights, normal, wanted = nodes[near], weights[near], normal[near], wanted[near]
    sharing = np.bincount(nodes.ravel(), minlength=len(points))
    backing = np.einsum('ckj,cj->ck', support[nodes], normal) * np.sign(weights)
    resistance = np.maximum(SUPPORTED * np.linalg.norm(support[nodes], axis=2), UNSUPPORTED)
    yielding = inverse_masses[nodes] * (backing > -resistance)
    wedged = np.einsum('ck,ck->c', weights**2, yielding) < WEDGED * np.einsum(
        'ck,ck->c', weights**2, inverse_masses[nodes])
    yielding = np.where(wedged[:, None], inverse_masses[nodes], yielding)
    mobility = np.einsum('ck,ck->c', weights**2, yielding * sharing[nodes])[:, None]
    mobility = np.where(mobility > 0, mobility, np.inf)  # both held
    resolved = velocities.copy()
    pushed = np.zeros(len(nodes))
    rubbed = np.zeros((len(nodes), 3))
    for _ in range(ITERATIONS):
        relative = np.einsum('ck,ckj->cj', weights, resolved[nodes])
        approach = np.einsum('cj,cj->c', relative, normal)
        push = np.maximum(pushed + (wanted - approach) / mobility[:, 0], 0)
        rub = rubbed - (relative - approach[:, None] * normal) / mobility
        size = np.linalg.norm(rub, axis=1)
        rub *= np.minimum(1, contact.friction * push / np.maximum(size, TINY))[:, None]
        impulses = (push - pushed)[:, None] * normal + rub - rubbed
        pushed, rubbed = push, rub
        np.add.at(resolved, nodes, (weights * yielding)[:, :, None] * impulses[:, None, :])
    passed_on = weights * (inverse_masses[nodes] - yielding)
    np.add.at(resolved, nodes, passed_on[:, :, None] * (pushed[:, None] * normal + rubbed)[:, None, :])
    return resolved


def closest(points, first, second):
    """
    Closest points of pairs of segments, (c,) indices of their first nodes.

    :returns: (c,) places s and t on the first and second segment, 0..1; (c, 3)
        unit normal from second to first; (c,) distance [m].
    """
    p, q = points[first], points[second]
    d1, d2 = points[first + 1] - p, points[second + 1] - q
    r = p - q
    a = np.einsum('ij,ij->i', d1, d1)
    e = np.einsum('ij,ij->i', d2, d2)
    b = np.einsum('ij,ij->i', d1, d2)
    c = np.einsum('ij,ij->i', d1, r)
    f = np.einsum('ij,ij->i', d2, r)
    determinant = a * e - b * b
    parallel = determinant < 1e-9 * a * e
    s = np.where(parallel, 0.5, np.clip((b * f - c * e) / np.where(parallel, 1, determinant), 0, 1))
    t = (b * s + f) / e
    clipped = np.clip(t, 0, 1)
    s = np.where(t == clipped, s, np.clip((b * clipped - c) / a, 0, 1))
    apart = r + s[:, None] * d1 - clipped[:, None] * d2
    distance = np.linalg.norm(apart, axis=1)
    upward = np.tile((0.0, 0.0, 1.0), (len(first), 1))  # any, where the axes meet
    normal = np.where(distance[:, None] > TINY, apart / np.maximum(distance, TINY)[:, None], upward)
    return s, clipped, normal, distance
