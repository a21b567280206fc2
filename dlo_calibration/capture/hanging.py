# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Hanging: the trial of a DLO that hangs between two clamps, from one photograph of it.

Nothing moves: the trial begins with the photographed shape, the clamps hold both ends, and the goal is where
the simulated DLO comes to rest from there.  Its frame has x to the right, z up, and the first end at x = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.vision.middle_line import along_line, arc_lengths
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Trace

CLAMPS = ('clamp_1', 'clamp_2')
IN_CLAMP = 0.005  # of the length between the clamps: how far the chain goes on into each
NEAR_CLAMP = 0.1  # of that length: the line next to a clamp, whose curve goes on to the clamp
BESIDE_CLAMP = 1.5  # widths of the DLO: so near to a clamp, its edges disturb the line
DEGREE = 4  # of that curve; a lower one bends too little, so that the clamp's direction is off by degrees
FEWEST = 10  # points that determine it
ABOVE_TABLE = 1.0  # m, height of the lowest point, so that no table touches it
#: Of a simulated DLO: it bends most beside its clamps, where a coarser one is stiffer than the real one is.
NODES = 121
COUNT = 41  # points of a chain, four of which are in the clamps
REST = 5.0  # s after which the simulated DLO is looked at


@dataclass(frozen=True, eq=False)
class HangingDlo:
    """
    A DLO that hangs between two clamps.

    :param chain: begins and ends inside the clamps: its first two and its last two points are in them.
    :param scale: of the photograph, in the frame of the chain.
    """

    chain: Chain
    scale: Scale


def straight_down(scale: Scale, line: Floats, plumb: ArrayLike | None = None) -> Floats:
    """
    Return the unit vector (2,) in the plane of a scale that points straight down.

    :param line: (n, 2) the DLO's [px].
    :param plumb: (2, 2) a higher and a lower pixel of something vertical; None: down in the photograph.
    :raises InputError: where both are at one place.
    """
    middle = line.mean(axis=0)
    ends = np.asarray(plumb, float) if plumb is not None else middle + [[0.0, -50.0], [0.0, 50.0]]
    upper, lower = scale.to_table(ends)[:, :2]
    size = float(np.linalg.norm(lower - upper))
    if not size > 0.0:
        raise InputError('plumb line', 'two clicks at one place', 'its upper and its lower end',
                         'click on both')
    return np.asarray((lower - upper) / size)


def hanging_dlo(trace: Trace, scale: Scale, down: Floats, count: int, away: float = 0.0,
                clamps: ArrayLike | None = None) -> HangingDlo:
    """
    Return the DLO that a photograph shows between two clamps.

    :param down: (2,) unit vector in the plane of the scale, straight down.
    :param count: of points of the chain.
    :param away: distance of the DLO's middle from the plane of the scale [m].
    :param clamps: (2, 2) a pixel in each clamp, on the DLO's middle; None: the DLO's own direction counts.
    """
    turn = np.array([[-down[1], down[0]], [-down[0], -down[1]]])  # rows: right and up
    line = scale.to_table(trace.pixels, away)[:, :2] @ turn.T
    disturbed = BESIDE_CLAMP * trace.width / float(arc_lengths(trace.pixels)[-1])
    first, leaves = _from_clamp(line, trace.sure, disturbed)
    last, enters = _from_clamp(first[::-1], trace.sure[::-1], disturbed)
    line = last[::-1]
    along = arc_lengths(line)
    inside = None if clamps is None else scale.to_table(clamps, away)[:, :2] @ turn.T
    ends = []
    for k, (mouth, away_from) in enumerate(((line[0], leaves), (line[-1], enters))):
        into = -away_from if inside is None else inside[k] - mouth
        size = float(np.linalg.norm(into))
        if not size > 0.0:
            raise InputError('clamps', 'a pixel at the end of the line', 'one inside the clamp',
                             'click further inside, on the middle of the DLO')
        ends.append(mouth + IN_CLAMP * along[-1] * into / size)
    flat = np.concatenate([ends[:1], along_line(line, along, np.linspace(0.0, along[-1], count - 2)),
                           ends[1:]])
    origin = np.array([line[0, 0], line[:, 1].min() - ABOVE_TABLE])
    flat -= origin
    chain = Chain(np.column_stack([flat[:, 0], np.zeros(count), flat[:, 1]]))
    right, up = np.column_stack([turn, np.zeros(2)])
    return HangingDlo(chain, replace(
        scale, rotation=scale.rotation @ np.column_stack([right, np.cross(up, right), up]),
        translation=scale.rotation @ [*(origin @ turn), away] + scale.translation))


def hanging_trial(name: str, chain: Chain) -> Trial:
    """Return the trial of a chain that hangs at rest between clamps, as `hanging_dlo` makes it."""
    last = len(chain) - 1
    times = np.array([0.0, 1.0])
    hands = tuple(Hand(clamp, grips, times, np.repeat(chain.points[place][None], 2, axis=0))
                  for clamp, grips, place in zip(CLAMPS, ((0, 1), (last - 1, last)), (1, last - 1),
                                                 strict=True))
    return Trial(name, chain, (Action(hands),), (Goal(chain, times[-1] + REST, True, CLAMPS),))


def with_ends(mass: float) -> float:
    """Return the mass of the whole chain [kg] if that from clamp to clamp is `mass`."""
    return mass * (1.0 + 2.0 * IN_CLAMP)


def _from_clamp(line: Floats, sure: NDArray[np.bool_], disturbed: float) -> tuple[Floats, Floats]:
    """
    Return a line (n, 2) with a smooth beginning, where it leaves a clamp, and its direction (2,) there.

    :param sure: (n,) False where the line is hidden or ambiguous.
    :param disturbed: share of the line that the clamp's edges disturb.
    """
    share = arc_lengths(line)
    share /= share[-1]
    near = share <= NEAR_CLAMP
    used = near & sure & (share >= disturbed)
    if used.sum() < FEWEST:
        used = near if near.sum() >= FEWEST else np.arange(len(line)) < FEWEST
    curve = [np.polyfit(share[used] / NEAR_CLAMP, column[used], min(DEGREE, used.sum() - 1))
             for column in line.T]
    begins = np.column_stack([np.polyval(one, share / NEAR_CLAMP) for one in curve])
    direction = np.array([one[-2] for one in curve])
    return np.where((share < disturbed)[:, None], begins, line), direction / math.hypot(*direction)
