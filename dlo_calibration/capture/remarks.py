# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Remarks: what a person should know about a trial that was read from photographs, and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Sequence

import numpy as np

from dlo_calibration.capture.chains import Axis
from dlo_calibration.capture.document import SameScale, TrialEntry
from dlo_calibration.capture.hands import Movements
from dlo_calibration.capture.readings import Reading
from dlo_calibration.capture.steps import Hold
from dlo_calibration.model.chain import Chain, Floats

LENGTHS = 0.02  # difference of the lengths of start and goal, from which on it is told
UNSURE = 0.1  # share of a line, likewise
AT_THE_END = 0.02  # share of a line at either end that shows whether its end was found
BESIDE = 0.006  # m; one line lies on the other where they are so near
STAYED = 0.5  # share of the points, those that moved least, by which the two directions are compared
REVERSED = 0.4  # times as far as in the given direction; with less, the other direction fits much better
LET_GO = 0.1  # of the length, between where a hand let a point go and where the goal shows it
FREE_END = 0.15  # of the length, from an end: there the DLO springs back by centimetres, not millimetres
CLEARED = 0.8  # of a diameter, by which the upper strand's curve is above the lower one's
LONGEST = 3600.0  # s that hands may move
SIZE_OF_A_MOVE = 0.01  # m; points that move less are hardly told from noise


@dataclass(frozen=True)
class Remark:
    """
    One sentence or two about a trial.

    :param level: `error`: there is no trial before this is mended; `warning`; `hint`.
    :param remedy: name of what the page can do about it.
    """

    level: str
    text: str
    remedy: str | None = None

    def plain(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {'level': self.level, 'text': self.text, 'remedy': self.remedy}


def error(text: str, remedy: str | None = None) -> Remark:
    """Return a remark without whose remedy there is no trial."""
    return Remark('error', text, remedy)


def about_photograph(reading: Reading, which: str, on_table: bool) -> list[Remark]:
    """
    Return what is missing or doubtful in a photograph, called e.g. `start`.

    :param on_table: whether the DLO lies on the table in it, wholly.
    """
    if reading.problem is not None:
        return [error(f'The {which} photograph cannot be read: {reading.problem}')]
    remarks = []
    if reading.scale_problem is not None:
        remarks.append(error(f'The {which} photograph has no scale: {reading.scale_problem}', 'set_scale'))
    elif reading.scale is None:
        remarks.append(error(f'The {which} photograph has no scale yet: lay the printed board beside the '
                             'DLO, or mark four known points.', 'set_scale'))
    trace = reading.trace
    if reading.trace_problem is not None:
        remarks.append(error(f'The line in the {which} photograph: {reading.trace_problem}', 'add_click'))
    elif trace is None:
        remarks.append(error(f'Click along the DLO in the {which} photograph, from one end to the other.',
                             'add_click'))
    if trace is None:
        return remarks
    open_ = [k for k in range(len(trace.crossings)) if k not in reading.answered and on_table]
    if open_:
        where = 'a crossing' if len(open_) == 1 else f'{len(open_)} crossings'
        remarks.append(Remark('warning', f'Say which strand is above at {where} in the {which} photograph; '
                              'until then it is guessed.', 'ask_crossings'))
    if on_table and reading.axis_problem is not None:
        remarks.append(error(f'The line in the {which} photograph: {reading.axis_problem}', 'set_scale'))
    unsure = 1.0 - float(trace.sure.mean())
    if unsure > UNSURE:
        remarks.append(Remark('warning', f'The line in the {which} photograph is not sure along '
                              f'{100 * unsure:.0f} % of it: check it, and add a click there.', 'add_click'))
    return remarks


def about_axes(start: Axis, goal: Axis, chains: tuple[Chain, Chain], shares: Floats, entry: TrialEntry,
               start_reading: Reading, goal_reading: Reading) -> list[Remark]:
    """Return what two axes tell when they are compared."""
    remarks = []
    here, there = (chain.points for chain in chains)
    if _fits_better_reversed(here, there):
        remarks.append(Remark('warning', 'The goal seems to be traced from the other end than the start, as '
                              'most of the DLO then stayed where it was: turn the order of its clicks round.',
                              'reverse_goal'))
        there = there[::-1]
    change = goal.length / start.length - 1.0
    if abs(change) > LENGTHS:
        longer = 'longer' if change > 0 else 'shorter'
        reason = _reason(start, goal, entry, start_reading, goal_reading, change)
        remarks.append(Remark(
            'warning', f'The DLO is {100 * abs(change):.1f} % {longer} in the goal ({goal.length:.3f} m) '
            f'than in the start ({start.length:.3f} m). {reason}', 'check_length'))
    if float(np.linalg.norm(there - here, axis=1).max()) < SIZE_OF_A_MOVE:
        remarks.append(Remark('hint', 'The DLO hardly moved, so this trial tells little: move it further.'))
    for which, axis, chain in (('start', start, chains[0]), ('goal', goal, chains[1])):
        if len(axis.over) and (axis.clearances(chain, shares) < CLEARED * axis.diameter).any():
            remarks.append(Remark('warning', f'The chain of the {which} has too few points to show how one '
                                  'strand goes over the other: raise the number of points.', 'more_points'))
    return remarks


def _fits_better_reversed(here: Floats, there: Floats) -> bool:
    """Tell whether (n, 3) points fit others much better in the reverse order."""
    stayed = max(int(STAYED * len(here)), 3)
    given, turned = (float(np.sort(np.linalg.norm(here - other, axis=1))[:stayed].mean())
                     for other in (there, there[::-1]))
    return given > SIZE_OF_A_MOVE and turned < REVERSED * given


def _reason(start: Axis, goal: Axis, entry: TrialEntry, start_reading: Reading, goal_reading: Reading,
            change: float) -> str:
    """Return the likely reason why two lengths differ, and what to do."""
    shorter, longer = (start, goal) if change > 0 else (goal, start)
    which = 'start' if change > 0 else 'goal'
    for axis, one in ((shorter, which), (longer, 'goal' if which == 'start' else 'start')):
        count = max(round(AT_THE_END * len(axis.sure)), 1)
        if not axis.sure[:count].any() or not axis.sure[-count:].any():
            return f'Probably an end of the DLO was not found in the {one} photograph, where the line is ' \
                'not sure: check both ends.'
    for end, name in ((slice(None, 1), 'first'), (slice(-1, None), 'last')):
        tip = shorter.points[end]
        gaps = np.linalg.norm(longer.points - tip, axis=1)
        place = float(longer.along[gaps.argmin()])
        missing = place if name == 'first' else longer.length - place
        if gaps.min() < BESIDE and LENGTHS / 2 * longer.length < missing < longer.length / 4:
            return f'The line in the {which} photograph probably ends too early at its {name} end: put the ' \
                'click at the end of the DLO.'
    if any(step.kind == 'two_hands' and step.values['motion'] == 'apart' and step.values['hold']
           for step in entry.steps) and 0 < change < 0.1:
        return 'Probably the hands stretch it: that is what this action shows. Else check both scales.'
    if isinstance(goal_reading.entry.scale, SameScale) or isinstance(start_reading.entry.scale, SameScale):
        return 'Probably the camera moved between the photographs, so they need a scale each; or a part of ' \
            'the DLO does not lie on the table, and looks longer.'
    return 'Probably a scale is wrong: compare the grid with the table in both photographs; or a part of ' \
        'the DLO does not lie on the table, and looks longer.'


def about_held(held: Sequence[Hold], entry: TrialEntry) -> list[Remark]:
    """Return what should be known about hands that hold the DLO at the start of a trial."""
    remarks = []
    for one in held:
        if one.raised and entry.start_side is None:
            remarks.append(error(f'At the start, {one.hand} holds the DLO in the air, as in the goal before: '
                                 'take a second photograph of that moment from the side.', 'add_side'))
        if not any(one.hand in step.hands for step in entry.steps):
            remarks.append(Remark('hint', f'{one.hand} holds the DLO at the start, as in the goal before, '
                                  'and goes on holding it: add a release if it opened.', 'add_step'))
    return remarks


def about_movements(moved: Movements, chains: tuple[Chain, Chain], radius: float, entry: TrialEntry,
                    held: Sequence[Hold]) -> list[Remark]:
    """Return what is doubtful about the paths of the hands; those in `held` hold the DLO at the start."""
    remarks = []
    lifted = moved.raised(radius)
    if lifted and entry.goal_side is None:
        remarks.append(error(
            f'In the goal, {lifted[0]} holds the DLO in the air. One photograph from above cannot show how '
            'it hangs: take a second one of the same moment from the side, or let the hand put it down.',
            'add_side'))
    if moved.end > LONGEST:
        remarks.append(error(f'The hands move for {moved.end:.0f} s, which takes too long to simulate: raise '
                             'their speed.'))
    for number in moved.unknown:
        remarks.append(Remark('warning', f'Step {number} grips a point that an earlier step may have moved: '
                              'take a photograph between the movements, and make each a trial of its own.'))
    opened = [(number, step) for number, step in enumerate(entry.steps, start=1)
              if step.kind in ('grasp_and_place', 'drag') and step.values['to'] is None and not (
                  set(step.hands) & set(moved.held_by))]
    for number, step in opened:
        near_end = not FREE_END < step.values['fraction'] < 1 - FREE_END
        remarks.append(Remark(
            'warning' if near_end else 'hint', f'Step {number}: the DLO springs back when the hand opens, so '
            'the goal does not quite show where that was. Mark the place in the goal photograph, or take it '
            'while the hand still holds.', 'mark_place'))
    last = {grip: hand for hand in moved.hands for grip in hand.grips}
    for grip, hand in last.items():
        moves = bool((hand.positions != hand.positions[0]).any())
        if not moves and any(one.hand == hand.name for one in held):
            continue  # it held the DLO before, and only opens, or goes on holding
        away = float(np.linalg.norm(hand.positions[-1] - chains[1].points[grip]))
        if away > LET_GO * chains[0].length:
            remarks.append(Remark('warning', f'{hand.name} ends {1000 * away:.0f} mm away from where the '
                                  'goal shows the point that it gripped: check where it gripped and let go.'))
        if not moves:
            remarks.append(Remark('hint', f'{hand.name} does not move.'))
    return remarks
