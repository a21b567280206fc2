# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels of the contact of a DLO with itself."""

from __future__ import annotations

import math

from dlo_calibration.simulation.compilation import part
from dlo_calibration.simulation.states import Contacts, Matrix, SelfContact, Vector

ITERATIONS = 10  # of the contact solver, as many as Bullet makes
PUSH_OUT = 0.8  # share of a penetration that one step corrects
FASTEST_PUSH_OUT = 0.8  # m/s; limits that correction, so that it does not throw the DLO apart
SUPPORTED = 0.5  # cosine between a push and the opposing support from which on the node is supported
UNSUPPORTED = 1e-6  # m/s; a smaller change of velocity is rounding, not support
WEDGED = 0.1  # least share of the mobility of a pair; with less it is wedged, and all its nodes yield
TINY = 1e-12  # m or m/s; shorter vectors have no direction


@part
def closest(points: Matrix, first: int, second: int) -> tuple[float, ...]:
    """
    Return the closest points of two segments (Ericson, Real-Time Collision Detection, 5.1.9).

    :returns: s and t, 0..1, their places on the first and on the second segment; the unit normal from
        the second to the first, three numbers; the distance [m].
    """
    p0, p1, p2 = points[first, 0], points[first, 1], points[first, 2]
    q0, q1, q2 = points[second, 0], points[second, 1], points[second, 2]
    u0, u1, u2 = points[first + 1, 0] - p0, points[first + 1, 1] - p1, points[first + 1, 2] - p2
    v0, v1, v2 = points[second + 1, 0] - q0, points[second + 1, 1] - q1, points[second + 1, 2] - q2
    r0, r1, r2 = p0 - q0, p1 - q1, p2 - q2
    a = u0 * u0 + u1 * u1 + u2 * u2
    e = v0 * v0 + v1 * v1 + v2 * v2
    b = u0 * v0 + u1 * v1 + u2 * v2
    c = u0 * r0 + u1 * r1 + u2 * r2
    f = v0 * r0 + v1 * r1 + v2 * r2
    determinant = a * e - b * b
    s = 0.5
    if not determinant < 1e-9 * a * e:
        s = min(max((b * f - c * e) / determinant, 0.0), 1.0)
    t = (b * s + f) / e
    clipped = min(max(t, 0.0), 1.0)
    if t != clipped:
        s = min(max((b * clipped - c) / a, 0.0), 1.0)
    n0 = r0 + s * u0 - clipped * v0
    n1 = r1 + s * u1 - clipped * v1
    n2 = r2 + s * u2 - clipped * v2
    distance = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if distance > TINY:
        return s, clipped, n0 / distance, n1 / distance, n2 / distance, distance
    return s, clipped, 0.0, 0.0, 1.0, distance


@part
def _find_contacts(capsules: SelfContact, near: int, points: Matrix, velocities: Matrix, step: float) -> int:
    """Write those of the first `near` pairs that would come too near within a step; return their number."""
    distances, diameter = capsules.distances, capsules.diameter
    pairs, contacts = capsules.pairs, capsules.contacts
    count = 0
    for k in range(near):
        i, j = pairs[k, 0], pairs[k, 1]
        s, t, n0, n1, n2, distance = closest(points, i, j)
        allowed = max(distances[i, j], min(distance, diameter))
        distances[i, j] = allowed
        gap = distance - allowed
        least = -gap / step if gap > 0 else min(-PUSH_OUT * gap / step, FASTEST_PUSH_OUT)
        approach = 0.0
        contact = contacts[count]
        contact.normal[0], contact.normal[1], contact.normal[2] = n0, n1, n2
        contact.nodes[0], contact.nodes[1], contact.nodes[2], contact.nodes[3] = i, i + 1, j, j + 1
        contact.weights[0], contact.weights[1] = 1 - s, s
        contact.weights[2], contact.weights[3] = -(1 - t), -t
        for m in range(4):
            at = contact.nodes[m]
            approach += contact.weights[m] * (
                velocities[at, 0] * n0 + velocities[at, 1] * n1 + velocities[at, 2] * n2)
        if approach < least:
            contact.least = least
            count += 1
    return count


@part
def _prepare(contacts: Contacts, count: int, inverse_masses: Vector, support: Matrix, change: Matrix) -> None:
    """
    Find out which nodes of the first `count` contacts yield, and how much.

    A node does not yield to a push towards a body that supports it, but passes the push on to that
    body: so a strand on a table carries another one.
    """
    change[:] = 0.0
    for k in range(count):
        for m in range(4):
            change[contacts[k].nodes[m], 0] += 1.0  # number of contacts that share the node
    for k in range(count):
        contact = contacts[k]
        given, full, shared = 0.0, 0.0, 0.0
        for m in range(4):
            at, w = contact.nodes[m], contact.weights[m]
            backing, size = 0.0, 0.0
            for c in range(3):
                backing += support[at, c] * contact.normal[c]
                size += support[at, c] * support[at, c]
            if w < 0:
                backing = -backing
            elif w == 0:
                backing = 0.0
            resistance = max(SUPPORTED * math.sqrt(size), UNSUPPORTED)
            contact.yielding[m] = inverse_masses[at] if backing > -resistance else 0.0
            given += w * w * contact.yielding[m]
            full += w * w * inverse_masses[at]
        for m in range(4):
            at = contact.nodes[m]
            if given < WEDGED * full:
                contact.yielding[m] = inverse_masses[at]
            shared += contact.weights[m]**2 * contact.yielding[m] * change[at, 0]
        contact.mobility = shared if shared > 0 else math.inf  # all nodes are held
        contact.pushed = 0.0
        for c in range(3):
            contact.rubbed[c] = 0.0


@part
def _push_apart(contacts: Contacts, count: int, friction: float, velocities: Matrix, change: Matrix) -> None:
    """Make one iteration of the solver over the first `count` contacts, with Coulomb friction."""
    change[:] = 0.0
    for k in range(count):
        contact = contacts[k]
        approach, size = 0.0, 0.0
        for c in range(3):
            relative = 0.0
            for m in range(4):
                relative += contact.weights[m] * velocities[contact.nodes[m], c]
            contact.impulse[c] = relative
            approach += relative * contact.normal[c]
        push = max(contact.pushed + (contact.least - approach) / contact.mobility, 0.0)
        for c in range(3):
            contact.impulse[c] = contact.rubbed[c] - (
                contact.impulse[c] - approach * contact.normal[c]) / contact.mobility
            size += contact.impulse[c]**2
        share = min(1.0, friction * push / max(math.sqrt(size), TINY))
        for c in range(3):
            rub = share * contact.impulse[c]
            contact.impulse[c] = rub - contact.rubbed[c] + (push - contact.pushed) * contact.normal[c]
            contact.rubbed[c] = rub
        contact.pushed = push
        for m in range(4):
            factor = contact.weights[m] * contact.yielding[m]
            for c in range(3):
                change[contact.nodes[m], c] += factor * contact.impulse[c]
    velocities += change


@part
def _pass_on(contacts: Contacts, count: int, inverse_masses: Vector, velocities: Matrix) -> None:
    """Let the nodes that did not yield pass the impulses on to the bodies that support them."""
    for k in range(count):
        contact = contacts[k]
        for m in range(4):
            at = contact.nodes[m]
            passed_on = contact.weights[m] * (inverse_masses[at] - contact.yielding[m])
            for c in range(3):
                velocities[at, c] += passed_on * (contact.pushed * contact.normal[c] + contact.rubbed[c])


@part
def keep_apart(contact: SelfContact, points: Matrix, velocities: Matrix, inverse_masses: Vector,
               support: Matrix, step: float) -> None:
    """
    Correct `velocities` so that segments do not pass through each other; call it where the DLO `is_near`.

    Contacts are velocity constraints, solved by Jacobi iterations with mass splitting (Tonge et al., Mass
    Splitting for Jitter-Free Parallel Rigid Body Simulation, 2012).

    :param points: (N, 3) [m] at the start of the step.
    :param velocities: (N, 3) [m/s] that the DLO would have without contact.
    :param inverse_masses: (N,) [1/kg], 0 for held nodes.
    :param support: (N, 3) [m/s] change of the velocities by other bodies in the last step.
    :param step: time step [s].
    """
    count = _find_contacts(contact, contact.near[0], points, velocities, step)
    if count == 0:
        return
    contacts, change = contact.contacts, contact.change
    _prepare(contacts, count, inverse_masses, support, change)
    for _ in range(ITERATIONS):
        _push_apart(contacts, count, contact.friction, velocities, change)
    _pass_on(contacts, count, inverse_masses, velocities)
