# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Warnings about a trial from photographs, and their remedies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from dlo_calibration.capture.document import HangingScale, SameScale, TrialEntry
from dlo_calibration.capture.hands import Hold, Movements
from dlo_calibration.capture.measurement import Measurement
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.vision.axis import Axis

LENGTHS = 0.02  # relative difference of the lengths of start and goal that is worth a warning
UNSURE = 0.1  # share of a line that is not sure, likewise
AT_THE_END = 0.02  # share of a line at either end that shows whether its end was found
BESIDE = 0.006  # m between two lines, at most, where one lies on the other
STAYED = 0.5  # share of the points, those that moved least, by which the two directions are compared
REVERSED = 0.4  # ratio of the distances in both directions below which the reverse fits much better
LET_GO = 0.1  # of the length, between the place where a hand opened and the gripped point in the goal
FREE_END = 0.15  # of the length, from an end: there the DLO springs back by centimetres, not millimetres
CLEARED = 0.8  # of a diameter, by which the upper strand is above the lower one, at least
LONGEST = 3600.0  # s that hands may move
SIZE_OF_A_MOVE = 0.01  # m; a smaller move is hardly distinguishable from noise


@dataclass(frozen=True)
class TrialWarning:
    """
    One sentence or two about a trial.

    :param level: `error`: there is no trial before this is corrected; `warning`; `hint`.
    :param remedy: name of the page's action against it.
    """

    level: str
    text: str
    remedy: str | None = None


class TrialWarnings(list[TrialWarning]):
    """The warnings about one trial, in the order in which they are shown."""

    def error(self, text: str, remedy: str | None = None) -> None:
        """Add a fault that must be corrected before there is a trial."""
        self.append(TrialWarning('error', text, remedy))

    def warning(self, text: str, remedy: str | None = None) -> None:
        """Add a probable fault."""
        self.append(TrialWarning('warning', text, remedy))

    def hint(self, text: str, remedy: str | None = None) -> None:
        """Add a possible improvement."""
        self.append(TrialWarning('hint', text, remedy))

    @property
    def has_errors(self) -> bool:
        """Whether a fault must be corrected before there is a trial."""
        return any(warning.level == 'error' for warning in self)


def check_photograph(warnings: TrialWarnings, photograph: Measurement, which: str, on_table: bool) -> None:
    """
    Warn of missing and doubtful things in a photograph.

    :param which: photograph of the trial, e.g. `start photograph`.
    :param on_table: whether the whole DLO lies on the table in it.
    """
    if photograph.problem is not None:
        warnings.error(f'The {which} cannot be read: {photograph.problem}')
        return
    if photograph.scale_problem is not None:
        warnings.error(f'The {which} has no scale: {photograph.scale_problem}', 'set_scale')
    elif photograph.scale is None:
        remedy = 'say how long the DLO is from clamp to clamp, or how far apart the clamps are' if (
            isinstance(photograph.entry.scale, HangingScale)) else (
            'lay the printed board beside the DLO, or mark four known points')
        warnings.error(f'The {which} has no scale yet: {remedy}.', 'set_scale')
    trace = photograph.trace
    if photograph.trace_problem is not None:
        warnings.error(f'The line in the {which}: {photograph.trace_problem}', 'add_click')
    elif trace is None:
        warnings.error(f'Click along the DLO in the {which}, from one end to the other.',
                       'add_click')
    if trace is None:
        return
    count = len(trace.crossings) - len(photograph.answered)
    if on_table and count:
        where = 'a crossing' if count == 1 else f'{count} crossings'
        warnings.warning(f'Say which strand is above at {where} in the {which}; until then it is '
                         'guessed.', 'ask_crossings')
    if on_table and photograph.axis_problem is not None:
        warnings.error(f'The line in the {which}: {photograph.axis_problem}', 'set_scale')
    unsure = 1.0 - float(trace.sure.mean())
    if unsure > UNSURE:
        warnings.warning(f'The line in the {which} is not sure along {100 * unsure:.0f} % of its '
                         'length: check it, and add a click there.', 'add_click')


def check_axes(warnings: TrialWarnings, axes: tuple[Axis, Axis], chains: tuple[Chain, Chain], shares: Floats,
               entry: TrialEntry, photographs: tuple[Measurement, Measurement]) -> None:
    """
    Warn where the axes and chains of start and goal hardly belong together.

    :param shares: (n,) fractions of the length at which the chains have points.
    """
    start, goal = axes
    before, after = (chain.points for chain in chains)
    if _fits_better_reversed(before, after):
        warnings.warning('The goal seems to be traced from the other end than the start, as most of the DLO '
                         'then stayed in its place: reverse the order of its clicks.', 'reverse_goal')
        after = after[::-1]
    change = goal.length / start.length - 1.0
    if abs(change) > LENGTHS:
        longer = 'longer' if change > 0 else 'shorter'
        reason = _reason_of_lengths(axes, entry, photographs, change)
        warnings.warning(f'The DLO is {100 * abs(change):.1f} % {longer} in the goal ({goal.length:.3f} m) '
                         f'than in the start ({start.length:.3f} m). {reason}', 'check_length')
    if float(np.linalg.norm(after - before, axis=1).max()) < SIZE_OF_A_MOVE:
        warnings.hint('The DLO hardly moved, so this trial shows little: move it further.')
    for which, axis, chain in zip(('start', 'goal'), axes, chains, strict=True):
        if len(axis.over) and (axis.clearances(chain, shares) < CLEARED * axis.diameter).any():
            warnings.warning(f'The chain of the {which} has too few points to show how one strand goes over '
                             'the other: raise the number of points.', 'more_points')


def check_hands(warnings: TrialWarnings, movements: Movements, chains: tuple[Chain, Chain], radius: float,
                entry: TrialEntry, held: Sequence[Hold]) -> None:
    """
    Warn of missing and doubtful movements of the hands.

    :param radius: of the DLO [m].
    :param held: the hands that hold the DLO at the start.
    """
    for hold in held:
        if hold.raised and entry.start_side is None:
            warnings.error(f'At the start, {hold.hand} holds the DLO in the air, as in the goal before: take '
                           'a second photograph of that moment from the side.', 'add_side')
        if not any(hold.hand in step.hands for step in entry.steps):
            warnings.hint(f'{hold.hand} holds the DLO at the start, as in the goal before, and goes on '
                          'holding it: add a release if it opened.', 'add_step')
    lifted = movements.raised(radius)
    if lifted and entry.goal_side is None:
        warnings.error(f'In the goal, {lifted[0]} holds the DLO in the air. One photograph from above cannot '
                       'show how it hangs: take a second one of the same moment from the side, or let the '
                       'hand put it down.', 'add_side')
    if movements.end > LONGEST:
        warnings.error(f'The hands move for {movements.end:.0f} s, which takes too long to simulate: raise '
                       'their speed.')
    for number in movements.unknown:
        warnings.warning(f'Step {number} grips a point that an earlier step may have moved: take a '
                         'photograph between the movements, and make each a trial of its own.')
    for number, step in enumerate(entry.steps, start=1):
        if step.kind in ('grasp_and_place', 'drag') and step.values['to'] is None and not (
                set(step.hands) & set(movements.held_by)):
            near_end = not FREE_END < step.values['fraction'] < 1 - FREE_END
            warn = warnings.warning if near_end else warnings.hint
            warn(f'Step {number}: the DLO springs back when the hand opens, so the goal does not show '
                 'exactly where it opened. Mark the place in the goal photograph, or take that photograph '
                 'while the hand still holds the DLO.', 'mark_place')
    last = {grip: hand for hand in movements.hands for grip in hand.grips}
    for grip, hand in last.items():
        moves = bool((hand.positions != hand.positions[0]).any())
        if not moves and any(hold.hand == hand.name for hold in held):
            continue  # it held the DLO before, and only opens or keeps holding
        distance = float(np.linalg.norm(hand.positions[-1] - chains[1].points[grip]))
        if distance > LET_GO * chains[0].length:
            warnings.warning(f'{hand.name} ends {1000 * distance:.0f} mm away from its gripped point in the '
                             'goal: check where it gripped and where it opened.')
        if not moves:
            warnings.hint(f'{hand.name} does not move.')


def _fits_better_reversed(before: Floats, after: Floats) -> bool:
    """Tell whether (n, 3) points fit others much better in the reverse order."""
    count = max(int(STAYED * len(before)), 3)
    given, reverse = (float(np.sort(np.linalg.norm(before - points, axis=1))[:count].mean())
                      for points in (after, after[::-1]))
    return given > SIZE_OF_A_MOVE and reverse < REVERSED * given


def _reason_of_lengths(axes: tuple[Axis, Axis], entry: TrialEntry,
                       photographs: tuple[Measurement, Measurement], change: float) -> str:
    """Return the likely reason why two lengths differ, and what to do."""
    shorter, longer = axes if change > 0 else axes[::-1]
    names = ('start', 'goal') if change > 0 else ('goal', 'start')
    for axis, name in zip((shorter, longer), names, strict=True):
        count = max(round(AT_THE_END * len(axis.sure)), 1)
        if not axis.sure[:count].any() or not axis.sure[-count:].any():
            return f'Probably an end of the DLO was not found in the {name} photograph, where the line is ' \
                'not sure: check both ends.'
    for end, which in ((slice(None, 1), 'first'), (slice(-1, None), 'last')):
        gaps = np.linalg.norm(longer.points - shorter.points[end], axis=1)
        place = float(longer.along[gaps.argmin()])
        missing = place if which == 'first' else longer.length - place
        if gaps.min() < BESIDE and LENGTHS / 2 * longer.length < missing < longer.length / 4:
            return f'The line in the {names[0]} photograph probably ends too early at its {which} end: put ' \
                'the click at the end of the DLO.'
    if any(step.kind == 'two_hands' and step.values['motion'] == 'apart' and step.values['hold']
           for step in entry.steps) and 0 < change < 0.1:
        return 'Probably the hands stretch it: that is what this action shows. Else check both scales.'
    if any(isinstance(photograph.entry.scale, SameScale) for photograph in photographs):
        return 'Probably the camera moved between the photographs, so they need a scale each; or a part of ' \
            'the DLO does not lie on the table, and looks longer.'
    return 'Probably a scale is wrong: compare the grid with the table in both photographs; or a part of ' \
        'the DLO does not lie on the table, and looks longer.'
