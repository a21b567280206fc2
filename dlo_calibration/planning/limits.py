# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Limits: where hands and DLO may be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping, Self

import numpy as np

from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Floats
from dlo_calibration.planning.options import HANDS, PlanOptions
from dlo_calibration.planning.regions import Box, read_box, read_reach, Region


@dataclass(frozen=True)
class Limits:
    """
    Where the hands of a plan can be, and where neither they nor the DLO may be.

    A hand counts as a point.

    :param reach: for each name in HANDS, where this hand can be; `told` the option that says so.
    :param no_go: boxes, by the texts that describe them.
    """

    reach: Mapping[str, Region]
    told: Mapping[str, str]
    no_go: Mapping[str, Box]

    @classmethod
    def of(cls, options: PlanOptions) -> Self:
        """Return the limits that options describe."""
        told = dict(zip(HANDS, (options.reach_1, options.reach_2), strict=True))
        return cls({name: read_reach(name, text) for name, text in told.items()}, told,
                   {text: read_box('no_go', text) for text in options.no_go})

    def refusal(self, action: Action) -> str:
        """
        Say which limit an action breaks: a phrase such as 'hand_1 leaves its reach, annulus 0 0 0.2 0.8'.

        :param action: its hands have names in HANDS; they move straight from waypoint to waypoint.
        :returns: empty if the hands keep to their reach, and out of the boxes.
        """
        for hand in action.hands:
            way = hand.positions if len(hand.positions) > 1 else hand.positions[[0, 0]]
            if not self.reach[hand.name].contains(way[:-1], way[1:]).all():
                return f'{hand.name} leaves its reach, {self.told[hand.name]}'
            if box := self._box(way[:-1], way[1:]):
                return f'{hand.name} enters the no-go box {box}'
        return ''

    def entered(self, chains: Floats) -> str:
        """
        Say that the DLO enters a box.

        :param chains: (m, n, 3) [m] the DLO at m instants.
        :returns: a phrase such as 'the DLO enters the no-go box 0 0 0 1 1 1'; empty if it enters none.
        """
        box = self.box(chains)
        return box and f'the DLO enters the no-go box {box}'

    def box(self, chains: Floats) -> str:
        """Return the text of the first box that the DLO enters in one of its chains, (m, n, 3) [m]."""
        return self._box(chains[:, :-1].reshape(-1, 3), chains[:, 1:].reshape(-1, 3)) if self.no_go else ''

    def _box(self, begin: Floats, end: Floats) -> str:
        """Return the text of the first box that one of the straight ways enters; empty if there is none."""
        return next((text for text, box in self.no_go.items() if np.any(box.entered(begin, end))), '')
