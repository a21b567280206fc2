# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Hand steps: where a hand is after each step of a simulation."""

from __future__ import annotations

import numpy as np

from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats, frozen_array


def hand_steps(hand: Hand, start: float, step: float, count: int) -> tuple[Floats, Floats | None, Floats]:
    """
    Return positions and rotations of a hand.

    :param start: time [s] in the trial.
    :param step: [s].
    :returns: (count + 1, 3) [m] positions after 0 to `count` steps; (count + 1, 3, 3) rotations until then,
        or None if it does not turn; (count + 1, 9) rotations in each step, row by row, and at last none.
    """
    positions, turns = hand.poses(start + step * np.arange(count + 1))
    each = np.concatenate([turns[1:] @ turns[:-1].transpose(0, 2, 1), np.eye(3)[None]]).reshape(-1, 9)
    turned = frozen_array(turns @ turns[0].T)
    return frozen_array(positions), None if np.all(turned == np.eye(3)) else turned, frozen_array(each)
