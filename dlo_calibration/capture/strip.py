# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The strip along a line: the photograph straightened, and what in it looks like the DLO.

Stations lie evenly along the line; at each, colours are read at offsets across it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from dlo_calibration.capture.ridge import Singles
from dlo_calibration.model.chain import Floats

BINS = (24, 40, 40)  # of L, a, b
LOW, SIZE = (0.0, -100.0, -100.0), (100.0, 200.0, 200.0)
DARKER = (0.9, 0.8, 0.65)  # L, a and b of the ground in shadows that take 25, 50 and 70 % of its light
UNKNOWN = 2e-3  # share of either class that may have any colour
MOST = 3.0  # limit of the logarithm of the odds
STRANGE = 0.3  # is taken off: what looks like neither is not the DLO


@dataclass(frozen=True, eq=False)
class Strip:
    """
    A straightened part of a photograph.

    :param line: (n, 2) stations [px].
    :param normals: (n, 2) unit vectors across, to the right of the line in the picture.
    :param half: (n,) [px] that one unit of the offsets is.
    :param offsets: (m,) across the line, evenly.
    :param lab: (n, m, 3) colours L, a, b.
    """

    line: Floats
    normals: Floats
    half: Floats
    offsets: Floats
    lab: Singles

    def at(self, offsets: Floats) -> Floats:
        """Return the pixels (n, 2) at offsets (n,), one for each station."""
        found: Floats = self.line + (offsets * self.half)[:, None] * self.normals
        return found


def lengths(line: Floats) -> Floats:
    """Return the arc length (n,) [px] at each point of a line (n, 2)."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def evenly(line: Floats, spacing: float) -> Floats:
    """Return a line (n, 2) with points about `spacing` apart, evenly."""
    arc = lengths(line)
    at = np.linspace(0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return np.column_stack([np.interp(at, arc, column) for column in line.T])


def smoothed(values: Floats, sigma: float) -> Floats:
    """Return (n, ...) values smoothed along the first axis; the ends stay where they are."""
    reach = min(len(values) - 1, int(4 * sigma) + 1)
    padded = np.concatenate([2 * values[0] - values[reach:0:-1], values,
                             2 * values[-1] - values[-2:-2 - reach:-1]])
    found: Floats = gaussian_filter1d(padded, max(sigma, 1e-3), axis=0)[reach:reach + len(values)]
    return found


def straighten(pixels: NDArray[np.uint8], line: Floats, half: Floats, offsets: Floats) -> Strip:
    """
    Read the colours along a line.

    :param pixels: (height, width, 3) RGB.
    :param line: (n, 2) [px], evenly.
    :param half: (n,) [px] that one unit of the offsets is.
    """
    tangents = np.gradient(line, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    at = line[:, None] + (half[:, None] * offsets)[..., None] * normals[:, None]
    low = np.maximum(np.floor(at.min(axis=(0, 1))).astype(int) - 2, 0)
    high = np.ceil(at.max(axis=(0, 1))).astype(int) + 3
    part = pixels[low[1]:max(high[1], low[1] + 1), low[0]:max(high[0], low[0] + 1)]
    places = (at - low).astype(np.float32)
    # OpenCV's remap takes at most 32767 rows, and reads whatever is aligned.
    colours = np.concatenate([
        cv2.remap(part, places[k:k + 16384, :, 0], places[k:k + 16384, :, 1], cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REPLICATE) for k in range(0, len(places), 16384)])
    lab: Any = cv2.cvtColor(colours.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2Lab)
    return Strip(line, normals, half, offsets, lab)


def learn_colours(strip: Strip, inner: float, outer: tuple[float, float]) -> Singles:
    """
    Return a table of the logarithm of the odds that a colour is the DLO's.

    :param inner: offsets below this are taken as the DLO.
    :param outer: offsets between these are taken as the ground; it may also be in shadow.
    """
    far = np.abs(strip.offsets)
    of_dlo = _share(strip.lab[:, far <= inner].reshape(-1, 3))
    outside = strip.lab[:, (far >= outer[0]) & (far <= outer[1])].reshape(-1, 3)
    shadows = sum((_share(outside * np.float32(k)) for k in DARKER), np.zeros(BINS))
    of_ground = 0.6 * _share(outside) + 0.4 / len(DARKER) * shadows
    least = UNKNOWN * of_dlo.mean() + 1e-7
    found: Singles = np.log((of_dlo + least) / (of_ground + least)).astype(np.float32).ravel()
    limited: Singles = np.clip(found - np.float32(STRANGE), -MOST, MOST)
    return limited


def odds(table: Singles, lab: Singles) -> Singles:
    """Return the logarithm of the odds (...) that colours (..., 3) are the DLO's."""
    found: Singles = table[_bin(lab)]
    return found


def _bin(lab: Singles) -> NDArray[np.int64]:
    found = np.zeros(lab.shape[:-1], dtype=np.int64)
    for k, bins in enumerate(BINS):
        scaled = (lab[..., k] - np.float32(LOW[k])) * np.float32(bins / SIZE[k])
        found = found * bins + np.clip(scaled, 0, bins - 1).astype(np.int64)
    return found


def _share(lab: Singles) -> Floats:
    counted = np.bincount(_bin(lab), minlength=BINS[0] * BINS[1] * BINS[2]).reshape(BINS).astype(float)
    found: Floats = gaussian_filter(counted, 0.8) / max(len(lab), 1)
    return found


def edges(strip: Strip, along: float) -> Singles:
    """
    Return the strength (n, m) of edges along the line.

    :param along: stations, standard deviation over which changes of colour must agree.
    """
    smooth = cv2.GaussianBlur(strip.lab, (0, 0), sigmaX=1.0, sigmaY=max(along, 0.3),
                              borderType=cv2.BORDER_REPLICATE)
    found: Singles = np.linalg.norm(np.gradient(smooth, axis=1), axis=2).astype(np.float32)
    return found
