# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Suspension: the stiffness of a DLO from the shape of its parts that hang in the air at rest."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Iterator, Sequence

import numpy as np

from dlo_calibration.model.chain import bezier_curve, Floats

RANK = {'free': 0, 'pin': 1, 'unknown': 2}  # number of unknown vectors at an end
#: LEVI_CIVITA[i, j, k] is component k of axis i x axis j.
LEVI_CIVITA = np.cross(np.eye(3)[:, None], np.eye(3)[None, :])


@dataclass(frozen=True)
class Part:
    """
    A part of a chain on which only its weight acts, and loads at its ends and at pinned points.

    :param first: index of its first point in the chain.
    :param last: index of its last point, included.
    :param ends: load at each end: ``free`` none, ``pin`` a force, ``unknown`` a force and a moment.
    :param pins: indices of points between the ends on which an unknown force acts.
    """

    first: int
    last: int
    ends: tuple[str, str]
    pins: tuple[int, ...] = ()


@dataclass(frozen=True)
class Balance:
    """
    The ratios of weight and stiffness that fit the shape of a part.

    :param load: weight per length over bending stiffness, w / EI [1/m^3]; noise can make it negative.
    :param std: standard deviation of `load` [1/m^3].
    :param stretch: weight per length over stretching stiffness, w / EA [1/m]; noise can make it negative.
    :param stretch_std: standard deviation of `stretch` [1/m]; infinite where the part has no tension.
    :param error: root mean square of the residual of a coordinate [m].
    """

    load: float
    std: float
    stretch: float
    stretch_std: float
    error: float


def hanging_parts(points: Floats, level: float | None, margin: float, forces: Sequence[int],
                  pinned: Sequence[int], touching: Sequence[int] = ()) -> Iterator[Part]:
    """
    Yield the hanging parts of a chain at rest.

    :param points: (n, 3) [m].
    :param level: height of the centre line where the DLO lies on the table [m]; None: there is no table.
    :param margin: points less than this above the level may touch the table [m].
    :param forces: points of clamps, which apply a force and a moment; they end a part.
    :param pinned: points that are held, but free to turn.
    :param touching: points that may touch another part of the DLO; parts with such points are left out.
    """
    last = len(points) - 1
    hangs = np.ones(len(points), bool) if level is None else points[:, 2] > level + margin
    stops = sorted({*(int(i) for i in np.flatnonzero(~hangs)), *forces})
    for before, after in zip([-1, *stops], [*stops, last + 1], strict=True):
        # A clamp at an end belongs to the part; a point on the table does not.
        first = before if before in forces else before + 1
        end = after if after in forces else after - 1
        if end - first < 2 or set(range(first, end + 1)) & set(touching):
            continue
        if not hangs[first:end + 1].all():
            continue
        ends = tuple('pin' if at in pinned and at not in forces else
                     'free' if at == tip and at not in forces else 'unknown'
                     for at, tip in ((first, 0), (end, last)))
        if ends == ('free', 'free') and not any(first < pin < end for pin in pinned):
            continue  # nothing holds it, so it is not at rest
        yield Part(first, end, (ends[0], ends[1]), tuple(pin for pin in sorted(pinned) if first < pin < end))


def balance(points: Floats, places: Floats, part: Part, noise: float) -> Balance | None:
    """
    Fit the balance of moments to a part: `EI t x t' = M`, where weight and hands cause the moment M.

    The balance (Antman, Nonlinear Problems of Elasticity, 2nd ed., 8.3) is integrated
    twice: `r = r0 + s t0 + integral integral (M / EI) x t` is linear in w / EI and in
    the forces and moments over EI, and needs no curvature of noisy points.  M is
    computed along the observed points first, then along the fitted shape.
    In a long part, a small error of the shape makes a large error of M far away.
    Such a part is cut into windows, which share w / EI and the forces; each has
    its own r0, t0 and moment.

    :param points: (n, 3) [m] of the whole chain.
    :param places: (n,) arc lengths of the points [m].
    :param noise: standard deviation of a coordinate [m].
    :returns: None where there are too few points for the unknowns.
    """
    observed = points[part.first:part.last + 1]
    along = places[part.first:part.last + 1] - places[part.first]
    pins, ends = [pin - part.first for pin in part.pins], part.ends
    if RANK[ends[1]] < RANK[ends[0]]:  # begin at the end with fewer unknowns
        observed, along, ends = observed[::-1], (along[-1] - along)[::-1], ends[::-1]
        pins = [len(observed) - 1 - pin for pin in pins][::-1]
    most = max(1, (len(observed) - 1) // 7)  # a window has seven segments or more
    best: Balance | None = None
    for windows in dict.fromkeys(min(count, most) for count in (1, 2, 4, 8)):
        found = _fit_windows(observed, along, ends[0], pins, windows, noise)
        if found is None:
            break
        if best is None:
            best = found
            continue
        agrees = abs(found.load - best.load) < 2 * math.hypot(found.std, best.std)
        if best.error < 1.5 * noise and agrees:  # the residuals are noise
            break
        # The errors of the shape in a window that is too long make the load too small.
        best = found if found.std < best.std or found.load > best.load else best
    return best


def _fit_windows(observed: Floats, along: Floats, first: str, pins: list[int], windows: int,
                 noise: float) -> Balance | None:
    """Return the balance of a part in windows; knowledge about its last end is not used."""
    system = _System(along, first, pins, windows)
    freedom = sum(len(own) for own, _ in system.rows) * 3 - system.count
    if freedom < 6:  # too few measured coordinates beyond the unknowns
        return None
    shape = bezier_curve(along, observed, system.fine)
    # Only below a free end is the tension known before the fit: it is the weight that hangs there.
    tension = np.array(system.fine) if system.held_at_end else np.zeros(len(shape))
    for step in range(6):  # alternately of the shape and the moments along it
        matrix, forces = system.columns(shape, tension)
        stretch = np.zeros((1, system.count))
        stretch[0, 1] = _integral(tension, system.fine)[-1] * noise / (0.05 * along[-1])  # prior: 5 % strain
        at = np.concatenate([own for own, _ in system.rows])
        right = np.concatenate([observed[at].ravel(), [0.0]])
        seen = np.concatenate([block[::system.each] for block in matrix])
        rows = np.concatenate([seen.reshape(-1, system.count), stretch])
        sizes = np.linalg.norm(rows, axis=0)
        sizes[sizes == 0] = 1
        solution = np.linalg.lstsq(rows / sizes, right, rcond=1e-11)[0] / sizes
        fitted = np.array(shape)
        for block, (_, own) in zip(matrix, system.rows, strict=True):
            fitted[own] = block @ solution
        change = np.abs(fitted - shape).max()
        if solution[0] > 0 and not system.held_at_end:
            tension = np.linalg.norm(forces @ solution, axis=1) / solution[0]
        shape = fitted if step == 0 else (shape + fitted) / 2
        if change < 0.02 * noise:
            break
    residual = right - rows @ solution
    error = float(np.sqrt(residual @ residual / freedom))
    inverse = np.linalg.pinv((rows / sizes).T @ (rows / sizes), rcond=1e-15) / np.outer(sizes, sizes)
    # 1.7: the shape along which moments are computed is noisy too.
    covariance = inverse * (1.7 * max(noise, error))**2
    load = float(solution[0])
    pull = float(_integral(tension, system.fine)[-1])
    # The length along a chain has an error of 0.3 %.
    stretch_std = np.inf if pull <= 0 else float(np.hypot(np.sqrt(max(covariance[1, 1], 0)),
                                                          0.003 * along[-1] / pull))
    return Balance(load, float(np.sqrt(covariance[0, 0])), float(solution[1]), stretch_std, error)


class _System:
    """
    The linear system of a part.

    Its unknowns are w / EI and w / EA; the forces at the first end and at each pin, over EI;
    and for each window r0, t0 and the moment at its beginning, over EI.

    :param along: (k,) arc lengths of the points of the part, from 0 [m].
    """

    def __init__(self, along: Floats, first: str, pins: list[int], windows: int) -> None:
        self.each = max(3, 200 // len(along))  # integration steps per segment
        self.fine = np.append(np.concatenate([np.linspace(a, b, self.each, endpoint=False) for a, b in
                                              zip(along[:-1], along[1:], strict=True)]), along[-1])
        borders = np.linspace(0, len(along) - 1, windows + 1).round().astype(int)
        #: for each window: the indices of its points, and its slice of `fine`
        self.rows = [(np.arange(a, b + 1), slice(a * self.each, b * self.each + 1))
                     for a, b in zip(borders[:-1], borders[1:], strict=True)]
        # indices in `fine` where forces act
        self._forces = [0] * (first != 'free') + [pin * self.each for pin in pins]
        self.held_at_end = not self._forces
        self._first = 2 + 3 * len(self._forces)
        self._turned = first == 'unknown'
        self.count = self._first + 9 * windows - (0 if self._turned else 3)

    def columns(self, shape: Floats, tension: Floats) -> tuple[list[Floats], Floats]:
        """
        Return the derivatives of the positions, and of the internal force, by the u unknowns.

        :param shape: (F, 3) [m] along which moments are computed.
        :param tension: (F,) tension over weight per length [m].
        :returns: (f, 3, u) positions for each window; (F, 3, u) internal force over EI.
        """
        force = np.zeros((len(self.fine), 3, self.count))
        force[:, 2, 0] = self.fine  # weight, upwards
        for k, pin in enumerate(self._forces):
            force[pin:, :, 2 + 3 * k:5 + 3 * k] = -np.eye(3)
        tangent = np.gradient(shape, self.fine, axis=0)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        turn = np.einsum('ijk,fj->fik', LEVI_CIVITA, tangent)  # turn @ v is tangent x v
        blocks = []
        column = self._first
        for number, (_, own) in enumerate(self.rows):
            s = self.fine[own] - self.fine[own.start]
            # Kirchhoff: M' = -t x N
            moment = -_integral(turn[own] @ force[own], s)
            if number or self._turned:
                moment[:, :, column + 6:column + 9] = np.eye(3)
            slope = _integral(-turn[own] @ moment, s)
            block = _integral(slope, s)
            block[:, :, 1] = _integral(tension[own, None] * tangent[own], s)
            block[:, :, column:column + 3] = np.eye(3)
            block[:, :, column + 3:column + 6] = s[:, None, None] * np.eye(3)
            column += 9 if number or self._turned else 6
            blocks.append(block)
        return blocks, force


def _integral(values: Floats, s: Floats) -> Floats:
    """Return (n, ...) integrals of (n, ...) values from the first of (n,) places to each, by trapezoids."""
    widths = np.diff(s).reshape(-1, *[1] * (values.ndim - 1))
    parts = np.cumsum(widths * (values[1:] + values[:-1]) / 2, axis=0)
    return np.concatenate([np.zeros_like(values[:1]), parts])  # SciPy's takes half a second to load
