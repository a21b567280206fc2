# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Bending: the shape of a DLO that nothing bends, and the moment that bends it.

`simulation.rod` simulates what these formulas say of a piece of it.
"""

from __future__ import annotations

from typing import Mapping

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import knot_names, KNOTS


def natural_curvature(physical: Mapping[str, float], fractions: Floats) -> Floats:
    """
    Return the (m, 2) components [1/m] of the curvature of the rest shape, in the material frame.

    :param physical: physical values by parameter name, in SI units.
    :param fractions: (m,) of the length, 0 to 1.
    """
    found = np.zeros((len(fractions), 2))
    found[:, 0] = physical.get('natural_curvature', 0.0)
    known = [physical[name] for name in knot_names(KNOTS[-1]) if name in physical]
    for axis in range(2 if known else 0):
        values = known[axis::2]
        found[:, axis] += np.interp(fractions, np.linspace(0, 1, len(values)), values)
    return found


def rest_shape(curvatures: Floats, length: float) -> Floats:
    """
    Return the shapes (..., m + 2, 3) [m] that begin in the origin and lead along x.

    The material frame is not twisted, so that it turns about ``t x k`` from segment to segment (Bishop, There
    is more than one way to frame a curve, 1975).

    :param curvatures: (..., m, 2) [1/m] at the joints of m + 1 equal segments.
    :param length: [m].
    """
    step = length / (curvatures.shape[-2] + 1)
    frame = np.broadcast_to(np.eye(3), (*curvatures.shape[:-2], 3, 3))  # columns: tangent, two across it
    tangents = [frame[..., 0]]
    for k in range(curvatures.shape[-2]):
        one, two = curvatures[..., k, 0] * step, curvatures[..., k, 1] * step
        size = np.hypot(one, two)
        along = np.stack([np.cos(size), np.sinc(size / np.pi) * one, np.sinc(size / np.pi) * two], axis=-1)
        # The smallest rotation from the x axis to `along`, of the frame's own axes.
        x, y, z = np.moveaxis(along, -1, 0)
        rest = 1 / np.maximum(1 + x, 1e-9)
        turn = np.stack([np.stack([x, -y, -z], axis=-1),
                         np.stack([y, 1 - y * y * rest, -y * z * rest], axis=-1),
                         np.stack([z, -y * z * rest, 1 - z * z * rest], axis=-1)], axis=-2)
        frame = frame @ turn
        tangents.append(frame[..., 0])
    steps = np.stack([np.zeros_like(tangents[0]), *tangents], axis=-2) * step
    return np.asarray(steps.cumsum(axis=-2))


def bending_moments(curvatures: Floats, stiffness: float, friction: float, slip: float) -> Floats:
    """
    Return the (m,) moments [N m] while a piece of DLO is bent in one plane.

    Strands that rub on each other are an elastic, perfectly plastic element beside the elastic bending (Iwan,
    A distributed-element model for hysteresis, 1966).  So each branch of a cycle is the first one, twice as
    large (Masing, 1926), and a cycle between -a and a takes the energy ``4 EI friction (a - slip)`` of each
    metre if a is larger than `slip`, and none if it is smaller.

    :param curvatures: (m,) [1/m], from that of the rest shape; at the first, the strands are free of stress.
    :param stiffness: EI [N m^2].
    :param friction: largest moment of the friction between strands, relative to EI [1/m].
    :param slip: change of curvature at which they slip [1/m].
    """
    stress = np.zeros(len(curvatures))
    for k, change in enumerate(np.diff(curvatures), start=1):
        stress[k] = np.clip(stress[k - 1] + friction / slip * change, -friction, friction)
    return stiffness * (curvatures + stress)
