# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Reality: a finer simulation with the true properties, in which planned actions are executed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.experiment.known_dlos import KnownDlo
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.planning.rehearsal import Job, rehearse, Step
from dlo_calibration.simulation.protocol import Simulator

HAND_REACH = 0.02  # m; a hand that closes further from the DLO grips nothing


class Reality:
    """
    A DLO on a table, on which hands act as a plan says, wherever the DLO may be.

    A hand closes at its first waypoint and grips the point of the DLO that is nearest to it, if that is
    within HAND_REACH.  Then it moves along its path, with the grip as far from its middle as when it closed.

    :param start: (N, 3) [m] points at rest, one for each node of the simulator.
    """

    def __init__(self, dlo: KnownDlo, start: Chain, simulator: Simulator) -> None:
        self.points = start.points  # (N, 3) [m] where the DLO is at rest now
        self._start = start
        self._physical = dlo.physical
        self._pool = Pool(simulator)
        self._steps: list[Step] = []

    @property
    def steps(self) -> tuple[Step, ...]:
        """What the hands really did so far."""
        return tuple(self._steps)

    def act(self, action: Action) -> bool:
        """
        Execute an action, after which all hands open; tell whether every hand gripped the DLO.

        :raises SimulationError: if the simulation diverges.
        """
        hands = tuple(hand for planned in action.hands if (hand := self._gripping(planned)) is not None)
        if hands:
            # All actions are simulated again, as a chain alone does not tell how much the DLO is stretched.
            steps = (*self._steps, Step(Action(hands)))
            found, = rehearse(self._pool, [Job(self._start, steps, self._physical)])
            if found.failure:
                raise SimulationError(found.failure)
            self._steps, self.points = list(steps), found.chains[-1]
        return len(hands) == len(action.hands)

    def _gripping(self, hand: Hand) -> Hand | None:
        """Return the path of a hand with the point that it really grips; None if it closes on nothing."""
        distances = np.linalg.norm(self.points - hand.positions[0], axis=1)
        nearest = int(distances.argmin())
        return replace(hand, grips=(nearest,)) if distances[nearest] <= HAND_REACH else None
