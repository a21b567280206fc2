# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Loads: how sharply a simulated DLO was bent, how hard it was pulled, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self, Sequence

import numpy as np

from dlo_calibration.model.chain import Floats, frozen_array

CURVATURE, TENSION, STRAIN = range(3)  # columns


@dataclass(frozen=True)
class Loads:
    """
    The largest loads of a DLO in each of k periods of time; doc/physics.md says how they are measured.

    :param most: (k, 3) the sharpest curvature of the middle line [1/m], the largest tension [N], and the
        largest strain; 0 where the DLO is straight, or nowhere stretched.
    :param places: (k, 3) [m] arc lengths where they occur, from the first point; 0 where there is no load.
    """

    most: Floats
    places: Floats

    def __post_init__(self) -> None:
        for name in ('most', 'places'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @classmethod
    def measured(cls, loads: Floats, places: Floats) -> Self:
        """
        Return what the core has measured.

        :param loads: (k, 3, 2) values, and where: indices of nodes, or half-way between two.
        :param places: (N,) [m] arc lengths of the nodes.
        """
        where: Floats = np.interp(loads[..., 1], np.arange(len(places)), places)
        return cls(loads[..., 0], where)

    def over(self, periods: Sequence[slice]) -> Loads:
        """Return the largest loads in groups of subsequent periods, at least one in each."""
        most, places = [], []
        for group in periods:
            rows = self.most[group].argmax(axis=0)[None]
            most.append(np.take_along_axis(self.most[group], rows, axis=0)[0])
            places.append(np.take_along_axis(self.places[group], rows, axis=0)[0])
        return Loads(np.array(most), np.array(places))
