# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The physics of the core once more, in NumPy, to compare with: short, and not made to be fast."""

import math

import numpy as np

# The core's constants; its headers explain them.
HELD = 1e12
HAIRPIN = 0.01
ROUNDED = 0.05
ITERATIONS, PUSH_OUT, FASTEST_PUSH_OUT = 10, 0.8, 0.8
SUPPORTED, UNSUPPORTED, WEDGED, TINY = 0.5, 1e-6, 0.1, 1e-12


def rod_velocities(rod, points, velocities):
    """Return the (N, 3) [m/s] velocities after one step, by a dense matrix."""
    diagonal, first, second = rod.bending.T
    bending = np.diag(diagonal)
    for offset, band in ((1, first[:-1]), (2, second[:-2])):
        bending += np.diag(band, offset) + np.diag(band, -offset)
    matrix = np.kron(np.diag(rod.masses * (1 + rod.drag * rod.step)) + rod.implicit * bending, np.eye(3))
    forces, returned = -bending @ points, rod.surplus * bending @ velocities
    for i, segment in enumerate(np.diff(points, axis=0)):
        slack = 1 - rod.rest_lengths[i] / np.linalg.norm(segment)
        tension = rod.stiffness[i] * slack * segment
        forces[i] += tension
        forces[i + 1] -= tension
        across = max(slack, 0) * rod.stiffness[i]
        block = (rod.stiffness[i] - across) * np.outer(segment, segment) / (segment @ segment)
        ends = np.kron([[1, -1], [-1, 1]], block + across * np.eye(3))
        taut = min(across * rod.step**2 / rod.masses[i:i + 2].min(), 1)
        implicit = rod.implicit + taut * max(rod.step**2 - rod.implicit, 0)
        matrix[3 * i:3 * i + 6, 3 * i:3 * i + 6] += implicit * ends
        kept = implicit * across * min(2 - 2 * taut, 1) * (velocities[i] - velocities[i + 1])
        returned[i] += kept
        returned[i + 1] -= kept
    if len(rod.angles):
        forces += frame_forces(points, rod)
    right = rod.masses[:, None] * velocities + rod.step * forces + returned
    pull = HELD * rod.masses[rod.held, None]
    right[rod.held] += pull * rod.follow
    at = (3 * rod.held[:, None] + np.arange(3)).ravel()
    matrix[at, at] += np.repeat(pull, 3)
    scale = 1 / np.sqrt(np.diag(matrix))  # what is held is 1e12 times as heavy
    solution = scale * np.linalg.solve(scale[:, None] * matrix * scale, scale * right.ravel())
    solution = solution.reshape(-1, 3)
    solution[rod.held] = rod.follow
    return solution





def bends_along(points, start=None):
    """
    Return the tangents (N - 1, 3), a frame that goes along without twist, and the bends in it.

    :param start: (3,) where the frame begins; None: anywhere.
    :returns: tangents, frame (N - 1, 3), lengths (N - 1,) [m]; complex bends, half angles' cosines (N - 2,).
    """
    segments = np.diff(points, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    tangents = segments / lengths[:, None]
    first, second = tangents[:-1], tangents[1:]
    half = np.sqrt(np.maximum((1 + np.einsum('ij,ij->i', first, second)) / 2, HAIRPIN))
    frame = frame_along(tangents, start)
    along, across = (np.einsum('ij,ij->i', second, axis[:-1])
                     for axis in (frame, np.cross(tangents, frame)))
    return tangents, frame, lengths, (along + 1j * across) / half, half


def frame_forces(points, state):
    """Return the forces of the material frame on the nodes, (N, 3) [N], at the angles that it has."""
    tangents, frame, lengths, bends, half = bends_along(points, state.bishop[1])
    natural = state.natural[:, 0] + 1j * state.natural[:, 1]
    if state.twisting.any():
        natural = natural * np.exp(0.5j * (state.angles[1:] + state.angles[:-1]))
        twists = state.twisting * np.diff(state.angles)
    else:  # it turns freely as a whole
        total = natural.conj() @ bends
        natural = natural * total / np.hypot(abs(total), ROUNDED * np.abs(natural).mean())
        slopes = np.imag(natural * bends.conj()) / 2
        twists = np.cumsum(slopes) + np.concatenate([[0.0], np.cumsum(slopes)[:-1]])
    sideways = np.cross(tangents, frame)
    first, second = tangents[:-1], tangents[1:]
    here = natural.real[:, None] * frame[:-1] + natural.imag[:, None] * sideways[:-1]
    there = natural.real[:, None] * frame[1:] + natural.imag[:, None] * sideways[1:]
    joints = (np.cross(second, here) + np.cross(first, there)) / (2 * half[:, None])
    joints += (np.real(natural.conj() * bends) / (4 * half**2))[:, None] * np.cross(first, second)
    joints -= (twists / (2 * half**2))[:, None] * (first + second)
    torques = np.zeros_like(tangents)
    torques[1:] += joints
    torques[:-1] -= joints
    couples = np.cross(torques, tangents) / lengths[:, None]
    forces = np.zeros_like(points)
    forces[1:] += couples
    forces[:-1] -= couples
    return forces


def least_energy(points, state, clamps=(), near=None):
    """
    Return the energy [J] of the material frame at the angles of least energy, and these angles.

    :param clamps: pairs of a segment and a unit vector (3,) of the frame there.
    :param near: (N - 1,) [rad] angles to begin with; None: those of the state.
    """
    _, frame, _, bends, _ = bends_along(points, state.bishop[1])
    tangents = np.diff(points, axis=0) / np.linalg.norm(np.diff(points, axis=0), axis=1)[:, None]
    natural = state.natural[:, 0] + 1j * state.natural[:, 1]
    if not state.twisting.any():
        return -np.hypot(abs(natural.conj() @ bends), ROUNDED * np.abs(natural).mean()), None
    angles = np.array(state.angles if near is None else near)
    for segment, direction in clamps:
        angle = _angle(frame[segment], direction, tangents[segment])
        angles[segment] = angle + 2 * np.pi * np.round((angles[segment] - angle) / (2 * np.pi))
    free = np.setdiff1d(np.arange(len(angles)), [segment for segment, _ in clamps])
    difference = np.diff(np.eye(len(angles)), axis=0)
    mean = np.abs(difference) / 2
    for _ in range(20):
        turned = natural * np.exp(1j * mean @ angles)
        slope = difference.T @ (state.twisting * (difference @ angles))
        slope += mean.T @ np.imag(turned * bends.conj())
        curvature = difference.T @ np.diag(state.twisting) @ difference
        curvature += mean.T @ np.diag(np.real(turned * bends.conj())) @ mean
        move = np.linalg.lstsq(curvature[np.ix_(free, free)], slope[free], rcond=1e-12)[0]
        angles[free] -= move
        if np.abs(move).max() < 1e-7:
            break
    turned = natural * np.exp(1j * mean @ angles)
    twist = (state.twisting * (difference @ angles)**2).sum() / 2
    return twist - np.real(turned * bends.conj()).sum(), angles


def frame_along(tangents, start=None):
    """Return (N - 1, 3) unit vectors perpendicular to the tangents that do not twist about them."""
    some = np.cross(tangents, np.eye(3)[np.abs(tangents).argmin(axis=1)])
    some /= np.linalg.norm(some, axis=1, keepdims=True)
    other = np.cross(tangents, some)
    first, second = tangents[:-1], tangents[1:]
    between = np.maximum(1 + np.einsum('ij,ij->i', first, second), 2 * HAIRPIN)
    there = some[:-1] - (np.einsum('ij,ij->i', second, some[:-1]) / between)[:, None] * (first + second)
    turned = np.arctan2(np.einsum('ij,ij->i', there, other[1:]), np.einsum('ij,ij->i', there, some[1:]))
    begin = 0.0 if start is None else _angle(some[0], start, tangents[0])
    angles = begin + np.concatenate([[0.0], np.cumsum(turned)])[:, None]
    # The angle from `some` of a vector that goes along without twist grows by what `some` lags behind it.
    return np.cos(angles) * some + np.sin(angles) * other


def _angle(first, second, tangent):
    """Return the angle about the tangent from one direction to another, (3,) each."""
    return math.atan2(np.cross(first, second) @ tangent, first @ second)


def without_penetration(places, start, radius, friction, points, velocities, inverse_masses, support, step):
    """
    Return the (N, 3) [m/s] velocities that contacts allow, from a check of every pair that may touch.

    :param places: (N,) [m] arc lengths of the nodes.
    :param start: (N, 3) [m] points at the start, where pairs may be nearer than a diameter.
    """
    half = np.diff(places) / 2
    middles = places[:-1] + half
    between = middles[None, :] - middles[:, None] - half[None, :] - half[:, None]
    first, second = np.nonzero(between > max(np.pi * radius, half.max()))
    allowed = np.minimum(closest(start, first, second)[3], 2 * radius)
    s, t, normal, distance = closest(points, first, second)
    gap = distance - np.maximum(allowed, np.minimum(distance, 2 * radius))
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
        rub *= np.minimum(1, friction * push / np.maximum(size, TINY))[:, None]
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
    separation = r + s[:, None] * d1 - clipped[:, None] * d2
    distance = np.linalg.norm(separation, axis=1)
    upward = np.tile((0.0, 0.0, 1.0), (len(first), 1))  # an arbitrary normal where the axes meet
    normal = np.where(distance[:, None] > TINY, separation / np.maximum(distance, TINY)[:, None], upward)
    return s, clipped, normal, distance
