# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials: from the readings of a start and a goal photograph, and the steps of the hands, to a trial."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.capture.chains import Axis
from dlo_calibration.capture.document import TrialEntry
from dlo_calibration.capture.hands import Movements, movements, PAUSE
from dlo_calibration.capture.readings import numbers, Reading
from dlo_calibration.capture.remarks import (
    about_axes,
    about_held,
    about_movements,
    about_photograph,
    error,
    Remark,
)
from dlo_calibration.capture.steps import Hold
from dlo_calibration.capture.two_views import axis_of_two_views
from dlo_calibration.errors import InputError
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import trial_messages
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.nodes import spread_places

SNAP = 0.25  # spacings of a chain: a hand that is so near to an end, or to another grip, is there


@dataclass(frozen=True, eq=False)
class ReadTrial:
    """
    A trial as far as it can be read.

    :param trial: as a session records it; None where something is missing or wrong.
    :param remarks: what the person should know.
    :param lengths: of the DLO in the start and the goal [m]; None: not known.
    :param hands: their paths.
    """

    remarks: tuple[Remark, ...]
    trial: Trial | None = None
    lengths: tuple[float | None, float | None] = (None, None)
    hands: tuple[Hand, ...] = ()
    start: Reading | None = None
    goal: Reading | None = None
    opened: frozenset[str] = frozenset()

    @cached_property
    def plain(self) -> dict[str, Any]:
        """What the page draws, as plain values."""
        return {'complete': self.trial is not None, 'remarks': [one.plain() for one in self.remarks],
                'start_length': self.lengths[0], 'goal_length': self.lengths[1],
                'hands': [self._plain_hand(hand) for hand in self.hands]}

    def _plain_hand(self, hand: Hand) -> dict[str, Any]:
        start, goal = (_pixels(one, hand.positions) for one in (self.start, self.goal))
        return {'name': hand.name, 'start_pixels': start, 'goal_pixels': goal, 'times': hand.times.tolist(),
                'grip': start[0] if start else None,
                'opens': goal[-1] if goal and hand.name in self.opened else None}


def _pixels(reading: Reading | None, positions: Floats) -> list[Any]:
    """Return where a photograph shows (k, 3) positions [m]."""
    return [] if reading is None or reading.scale is None else numbers(reading.scale.to_pixels(positions))


def read_trial(number: int, entry: TrialEntry, readings: dict[str, Reading],
               held: Sequence[Hold] = ()) -> ReadTrial:
    """
    Return the trial that a document describes, or why there is none yet.

    :param number: of the trial, from 1.
    :param readings: of all photographs, by id.
    :param held: the hands that hold the DLO at the start.
    """
    remarks: list[Remark] = []
    axes = []
    shown: dict[str, Reading] = {}
    for which, one, side in (('start', entry.start, entry.start_side), ('goal', entry.goal, entry.goal_side)):
        axis = None
        if one is None:
            remarks.append(error('Add a photograph of the DLO after the movement.', 'add_goal'))
        else:
            shown[which] = readings[one]
            remarks += about_photograph(readings[one], which, side is None)
            axis = readings[one].axis
            if side is not None:
                remarks += about_photograph(readings[side], f'second {which}', False)
                axis = _in_space(which, readings[one], readings[side], remarks)
        axes.append(axis)
    lengths = tuple(None if axis is None else axis.length for axis in axes)
    start, goal = axes
    if not entry.steps:
        remarks.append(error('Say what the hand did between the two photographs.', 'add_step'))
    begun = ReadTrial((), lengths=(lengths[0], lengths[1]), start=shown.get('start'), goal=shown.get('goal'))
    if start is None or goal is None:
        return replace(begun, remarks=tuple(remarks))
    shares = _shares(entry, held, begun.start.count if begun.start else 21)
    try:
        chains = start.chain(shares), goal.chain(shares)
    except InputError as refusal:
        return replace(begun, remarks=(*remarks, error(str(refusal))))
    remarks += about_axes(start, goal, chains, shares, entry, shown['start'], shown['goal'])
    moved = None
    if entry.steps:
        try:
            moved = movements(entry.steps, *chains, lambda fraction: int(np.abs(shares - fraction).argmin()),
                              start.diameter / 2, entry.goal_side is not None, held)
        except InputError as refusal:
            remarks.append(error(f'The steps of the hands contradict each other: {refusal}'))
    if moved is None:
        return replace(begun, remarks=tuple(remarks))
    remarks += about_held(held, entry)
    remarks += about_movements(moved, chains, start.diameter / 2, entry, held)
    trial = None
    if not any(one.level == 'error' for one in remarks):
        trial = _recorded(f'trial {number}', chains, moved, remarks)
    return replace(begun, remarks=tuple(remarks), trial=trial, hands=moved.hands,
                   opened=frozenset(hand.name for hand in moved.hands) - set(moved.held_by))


def _in_space(which: str, above: Reading, side: Reading, remarks: list[Remark]) -> Axis | None:
    """Return the axis of a DLO that two photographs of one moment show."""
    if above.thickness is None or above.trace is None or above.scale is None or side.trace is None or (
            side.scale is None):
        return None
    try:
        return axis_of_two_views(above.trace, above.scale, side.trace, side.scale, above.thickness)
    except InputError as refusal:
        remarks.append(error(f'The two photographs of the {which} do not give the DLO in space: {refusal}'))
        return None


def _shares(entry: TrialEntry, held: Sequence[Hold], count: int) -> Floats:
    """Return the fractions of the length, (count,), at which the chain has points: one at each grip."""
    near = SNAP / (count - 1)
    fixed = [0.0, 1.0]
    grips = [one for step in entry.steps for one in step.fractions] + [one.fraction for one in held]
    for fraction in sorted(grips):
        if all(abs(fraction - other) > near for other in fixed) and len(fixed) < count:
            fixed.append(fraction)
    return spread_places(np.sort(np.array(fixed)), count)


def _recorded(name: str, chains: tuple[Chain, Chain], moved: Movements,
              remarks: list[Remark]) -> Trial | None:
    """
    Return the trial as it is when a recorded session of it is read again.

    So the page calibrates with exactly the numbers of the session.
    """
    try:
        trial = Trial(name, chains[0], moved.actions,
                      (Goal(chains[1], moved.end + PAUSE, True, moved.held_by),))
        collector = TrialCollector(Options())
        for message in trial_messages((trial,), 'world'):
            collector.add(message)
    except InputError as refusal:
        remarks.append(error(str(refusal)))
        return None
    found = collector.trials
    if len(found) != 1 or not _same(found[0], trial):
        remarks.append(error('This order of steps cannot be kept in a session: take a photograph between the '
                             'movements, and make each a trial of its own.'))
        return None
    return replace(found[0], name=name)


def _same(found: Trial, trial: Trial) -> bool:
    """Tell whether a trial has all hands of another one, with their grips, and the same hold its goal."""
    paths = {(hand.name, hand.grips, round(hand.start, 6), round(hand.end, 6)) for hand in found.hands}
    return found.goals[0].stable and set(found.goals[0].held_by) == set(trial.goals[0].held_by) and all(
        (hand.name, hand.grips, round(hand.start, 6), round(hand.end, 6)) in paths for hand in trial.hands)


def numbered(trials: Sequence[ReadTrial]) -> tuple[Trial, ...]:
    """Return the complete trials, named as a session that is read names them."""
    complete = [one.trial for one in trials if one.trial is not None]
    return tuple(replace(trial, name=f'trial {number}') for number, trial in enumerate(complete, start=1))
