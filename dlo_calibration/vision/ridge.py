# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Ridge measure: how much each pixel looks like the middle of the DLO, learned at the clicks.

A DLO is a ridge or a valley of brightness or colour: its second derivative across is large (Lindeberg, Edge
detection and ridge detection with automatic scale selection, 1998).  The photograph is reduced in steps, so
that at one level the DLO is a few pixels wide.  Fisher's discriminant gives the mixture of L, a and b that
separates it best from the ground: the mean at the clicks against the covariance everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

Singles = NDArray[np.float32]

FINEST = 1000.0  # px, the longer side of the finest level
COARSEST = 64.0  # px, of the coarsest
BLUR = 1.0  # px of a level, standard deviation of the derivatives
WIDTH = 3.2  # px of a level: the width of a DLO that is traced there
NEAR = 14.0  # px in a photograph of 4000 px: usual distance of a click from the DLO; up to FAR times as much
FAR = 5.0
STRONGEST = 0.85  # share of the strongest ridge that a wider level must have to be preferred
GROUND = 0.8  # share of the pixels that count as the ground's
LIGHTNESS = 10.0  # L for a logarithm of the odds of 1
ANGLES = np.arange(16) * (math.pi / 16)


@dataclass(frozen=True, eq=False)
class Level:
    """
    The photograph reduced.

    :param factor: pixels of the photograph to a pixel of the level.
    :param lab: (h, w, 3) L, a, b.
    :param curvature: (h, w, 3, 3) second derivatives xx, xy, yy (third axis) of L, a, b (last axis).
    :param inverse: (3, 3) inverse of the covariance of the ground's second derivatives.
    """

    factor: float
    lab: Singles
    curvature: Singles
    inverse: Floats

    @classmethod
    def reduced(cls, lab: Singles, factor: float) -> Level:
        """Return the level of a reduced photograph (h, w, 3) L, a, b."""
        smooth = cv2.GaussianBlur(lab, (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE)
        curvature = np.empty((*lab.shape[:2], 3, 3), dtype=np.float32)
        for k, (dx, dy) in enumerate(((2, 0), (1, 1), (0, 2))):
            # Sobel's kernels of 3 pixels sum up to 4.
            curvature[:, :, k] = cv2.Sobel(smooth, cv2.CV_32F, dx, dy, ksize=3, scale=0.25,
                                           borderType=cv2.BORDER_REPLICATE)
        sample = curvature[::2, ::2, ::2].reshape(-1, 3)  # xx and yy
        covariance: Floats = np.eye(3)
        for _ in range(2):
            # The DLO itself and its shadow do not count.
            size = np.einsum('ni,ij,nj->n', sample, np.linalg.inv(covariance), sample)
            ground = sample[size <= np.quantile(size, GROUND)]
            covariance = ground.T @ ground / len(ground) + 0.05 * np.eye(3)
        inverse: Floats = np.linalg.inv(covariance).astype(float)
        return cls(factor, lab, curvature, inverse)

    def showing(self, looks: Singles) -> Level:
        """Return the same level of how much each pixel (h, w) of the finest one looks like the DLO."""
        lab = np.zeros_like(self.lab)
        lab[..., 0] = cv2.resize(LIGHTNESS * looks, lab.shape[1::-1], interpolation=cv2.INTER_AREA)
        return Level.reduced(lab, self.factor)


@dataclass(frozen=True, eq=False)
class Ridge:
    """
    The ridge measure of one level.

    :param factor: pixels of the photograph to a pixel of the level.
    :param hessian: (h, w, 3) xx, xy, yy; the second derivative across is 1 in the middle of the DLO.
    :param floor: that derivative of the ground: three quarters of all pixels have less.
    :param width: rough width of the DLO [px of the photograph].
    """

    factor: float
    hessian: Singles
    floor: float
    width: float


def levels(pixels: NDArray[np.uint8]) -> list[Level]:
    """Reduce a photograph (height, width, 3) RGB in steps of the square root of 2."""
    longer = max(pixels.shape[:2])
    factor = max(1.0, longer / FINEST)
    reduced_levels: list[Level] = []
    image: NDArray[Any] = pixels
    while not reduced_levels or longer / factor >= COARSEST:
        height, width = (max(8, round(side / factor)) for side in pixels.shape[:2])
        reduced = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        lab: Any = cv2.cvtColor(reduced.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2Lab)
        reduced_levels.append(Level.reduced(lab, factor))
        if factor <= longer / FINEST * 2:
            image = reduced if factor > 1 else image
        factor *= math.sqrt(2)
    return reduced_levels


def learn(levels: list[Level], clicks: Floats) -> Ridge:
    """
    Choose the level, and the mixture of L, a and b, that separate the DLO at the clicks best from the ground.

    :param clicks: (k, 2) [px].
    """
    measures = [_at_clicks(level, clicks) for level in levels]
    # A bar's ridge is the strongest where its width is twice the blur; one level finer is more exact.
    strengths = np.array([np.linalg.norm(mean) for _, _, mean in measures])
    chosen = max(0, int(np.nonzero(strengths >= STRONGEST * strengths.max())[0][-1]) - 1)
    level, (weights, typical, _) = levels[chosen], measures[chosen]
    hessian = level.curvature @ (weights / typical).astype(np.float32)
    half = (hessian[..., 0] + hessian[..., 2]) / 2
    largest = half + np.hypot((hessian[..., 0] - hessian[..., 2]) / 2, hessian[..., 1])
    floor = float(np.quantile(largest[::2, ::2], 0.75))
    return Ridge(level.factor, np.ascontiguousarray(hessian), min(floor, 0.5), WIDTH * level.factor)


def _at_clicks(level: Level, clicks: Floats) -> tuple[Floats, float, Floats]:
    """Return the weights of L, a, b, their response in the DLO's middle, and the mean derivative there."""
    height, width = level.lab.shape[:2]
    reach = NEAR / 4000 * max(height, width) + 1.0
    across = np.column_stack([np.cos(ANGLES) ** 2, 2 * np.cos(ANGLES) * np.sin(ANGLES), np.sin(ANGLES) ** 2])
    candidates = []
    for u, v in (clicks + 0.5) / level.factor - 0.5:
        left, right = max(0, int(u - FAR * reach)), min(width, int(u + FAR * reach) + 2)
        top, bottom = max(0, int(v - FAR * reach)), min(height, int(v + FAR * reach) + 2)
        part = level.curvature[top:bottom, left:right].astype(float)
        y, x = np.mgrid[top:bottom, left:right]
        distance = np.hypot(x - u, y - v)
        inside = distance <= max(FAR * reach, float(distance.min()))
        turned = np.einsum('ak,nkc->nac', across, part[inside])
        # The derivative along the line is subtracted: a speck has as much along as across.
        along = np.roll(turned, len(ANGLES) // 2, axis=1)
        weight = 1 / (1 + (distance[inside] / (2 * reach)) ** 2)[:, None]
        candidates.append((turned, along, weight))

    def pick(weights: Floats | None) -> Floats:
        """Return the vector (3,) of the strongest ridge at each click."""
        picked = []
        for turned, along, weight in candidates:
            if weights is None:
                strength = (np.sqrt(np.einsum('nai,ij,naj->na', turned, level.inverse, turned))
                            - np.sqrt(np.einsum('nai,ij,naj->na', along, level.inverse, along)))
            else:
                strength = turned @ weights - np.abs(along @ weights)
            n, a = np.unravel_index(int(np.argmax(strength * weight)), strength.shape)
            picked.append(turned[n, a])
        return np.array(picked)

    vectors = pick(None)
    sizes = np.sqrt(np.einsum('ni,ij,nj->n', vectors, level.inverse, vectors))
    # Begin with the click that agrees best with the others.
    alike = (vectors @ level.inverse @ vectors.T) / np.maximum(np.outer(sizes, sizes), 1e-12)
    mean = vectors[np.argmax(alike.sum(axis=1))]
    # Tape under some of the clicks, or a hand beside them, must not decide: so the median counts.
    for _ in range(3):
        weights = level.inverse @ mean
        vectors = pick(weights)
        mean = np.median(vectors, axis=0)
    weights = level.inverse @ mean
    typical = max(float(np.median(vectors @ weights)), 1e-9)
    return weights, typical, mean
