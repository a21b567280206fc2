# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Trials: drafts from the measured photographs of a start and a goal, and the steps of the hands.

A draft reuses the unchanged parts of the last one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.options import FileOptions, Options, recordable
from dlo_calibration.capture.document import HangingScale, TrialEntry
from dlo_calibration.capture.hands import held_after, Hold, move, Movements, PAUSE
from dlo_calibration.capture.hanging import hanging_trial, NODES, with_ends
from dlo_calibration.capture.json_values import plain
from dlo_calibration.capture.measurement import Measurement, Measurer, numbers
from dlo_calibration.capture.obstacles import lines_around, place_obstacles, PlacedObstacle, seen_lines
from dlo_calibration.capture.project import Project
from dlo_calibration.capture.trial_warnings import check_axes, check_hands, check_photograph, TrialWarnings
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.digest import digest
from dlo_calibration.files.recording import write_records
from dlo_calibration.files.request import Request, TrialRequest
from dlo_calibration.files.request import write_request as write_document
from dlo_calibration.files.session import trial_records
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import trial_messages
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, SCALE
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.nodes import spread_places
from dlo_calibration.simulation.scene import Obstacle
from dlo_calibration.vision.axis import Axis
from dlo_calibration.vision.two_views import axis_of_two_views

SNAP = 0.25  # spacings of a chain: a hand nearer than this to an end, or to another grip, is put there

#: Slow errors of a film, and of photographs whose marks of a hand are off by a millimetre, as rendered ones
#: have them (benchmark/film_trials.py, benchmark/from_photographs.py).
FILM_ERRORS = {'slow_chain_error': 0.0005, 'slow_hand_error': 0.002}
PHOTOGRAPH_ERRORS = {'slow_chain_error': 0.0003, 'slow_hand_error': 0.003}


@dataclass(frozen=True, eq=False)
class TrialDraft:
    """
    A trial as far as the document describes it.

    :param trial: as a session records it; None: it is incomplete or wrong.
    :param movements: of the hands; None: unknown.
    :param hangs: between two clamps.
    :param name: as the person calls it; empty: by its number.
    """

    warnings: TrialWarnings
    start: Measurement | None = None
    goal: Measurement | None = None
    movements: Movements | None = None
    trial: Trial | None = None
    hangs: bool = False
    name: str = ''

    @cached_property
    def plain(self) -> dict[str, Any]:
        """The draft as plain values, for the page."""
        hands = () if self.movements is None else self.movements.hands
        return {'name': self.name, 'complete': self.trial is not None,
                'warnings': plain(tuple(self.warnings)),
                'hands': [{'name': hand.name, 'times': hand.times.tolist(),
                           'start_pixels': _pixels(self.start, hand.positions),
                           'goal_pixels': _pixels(self.goal, hand.positions)} for hand in hands]}


def _pixels(photograph: Measurement | None, positions: Floats) -> list[Any]:
    """Return where a photograph shows (k, 3) positions [m]."""
    return [] if photograph is None or photograph.scale is None else numbers(
        photograph.scale.to_pixels(positions))


def draft_trial(number: int, entry: TrialEntry, photographs: Mapping[str, Measurement],
                held: Sequence[Hold] = ()) -> TrialDraft:
    """
    Return the trial that a document describes, or the warnings that say why there is none yet.

    :param number: of the trial, from 1.
    :param photographs: all measurements, by id.
    :param held: the hands that hold the DLO at the start.
    """
    warnings = TrialWarnings()
    if isinstance(photographs[entry.start].entry.scale, HangingScale):
        return _hanging_draft(number, photographs[entry.start], warnings)
    begin, start = _axis('start', entry.start, entry.start_side, photographs, warnings)
    end, goal = _axis('goal', entry.goal, entry.goal_side, photographs, warnings)
    if not entry.steps:
        warnings.error('Say what the hand did between the two photographs.', 'add_step')
    draft = TrialDraft(warnings, begin, end)
    if begin is None or start is None or end is None or goal is None:
        return draft
    shares = _shares(entry, held, begin.count)
    try:
        chains = start.chain(shares), goal.chain(shares)
    except InputError as refusal:
        warnings.error(str(refusal))
        return draft
    check_axes(warnings, (start, goal), chains, shares, entry, (begin, end))
    if not entry.steps:
        return draft
    radius = start.diameter / 2
    try:
        movements = move(entry.steps, *chains, lambda fraction: int(np.abs(shares - fraction).argmin()),
                         radius, entry.goal_side is not None, held)
    except InputError as refusal:
        warnings.error(f'The steps of the hands contradict each other: {refusal}')
        return draft
    check_hands(warnings, movements, chains, radius, entry, held)
    if warnings.has_errors:
        return replace(draft, movements=movements)
    try:
        stable = Goal(chains[1], movements.end + PAUSE, True, movements.held_by)
        trial = _recorded(Trial(f'trial {number}', chains[0], movements.actions, (stable,)), warnings)
    except InputError as refusal:
        warnings.error(str(refusal))
        trial = None
    return replace(draft, movements=movements, trial=trial)


def _hanging_draft(number: int, photograph: Measurement, warnings: TrialWarnings) -> TrialDraft:
    """Return the trial of a photograph of a DLO that hangs."""
    check_photograph(warnings, photograph, 'photograph', on_table=False)
    hanging = photograph.hanging
    trial = None if warnings.has_errors or hanging is None else _recorded(
        hanging_trial(f'trial {number}', hanging.chain), warnings)
    return TrialDraft(warnings, photograph, trial=trial, hangs=True)


def _axis(which: str, photograph: str | None, side: str | None, photographs: Mapping[str, Measurement],
          warnings: TrialWarnings) -> tuple[Measurement | None, Axis | None]:
    """
    Return the photograph of a start or goal, and the axis of the DLO in it.

    :param which: `start` or `goal`.
    :param photograph: its id.
    :param side: the id of a second photograph of the same moment, from the side.
    """
    if photograph is None:
        warnings.error('Add a photograph of the DLO after the movement.', 'add_goal')
        return None, None
    above = photographs[photograph]
    check_photograph(warnings, above, f'{which} photograph', side is None)
    if side is None:
        return above, above.axis
    second = photographs[side]
    check_photograph(warnings, second, f'second {which} photograph', False)
    if above.thickness is None or above.trace is None or above.scale is None or second.trace is None or (
            second.scale is None):
        return above, None
    try:
        return above, axis_of_two_views(above.trace, above.scale, second.trace, second.scale, above.thickness)
    except InputError as refusal:
        warnings.error(f'The two photographs of the {which} do not give the DLO in space: {refusal}')
        return above, None


def _shares(entry: TrialEntry, held: Sequence[Hold], count: int) -> Floats:
    """Return the fractions of the length, (count,), at which the chain has points: one at each grip."""
    near = SNAP / (count - 1)
    fixed = [0.0, 1.0]
    grips = [*(fraction for step in entry.steps for fraction in step.fractions),
             *(hold.fraction for hold in held)]
    for fraction in sorted(grips):
        if all(abs(fraction - other) > near for other in fixed) and len(fixed) < count:
            fixed.append(fraction)
    return spread_places(np.sort(np.array(fixed)), count)


def _recorded(trial: Trial, warnings: TrialWarnings) -> Trial | None:
    """
    Return a trial as read from a recorded session of it; None, and a warning, where that cannot be.

    The page thus calibrates with exactly the numbers of the session.
    """
    try:
        collector = TrialCollector(Options())
        for message in trial_messages((trial,), 'world'):
            collector.add(message)
    except InputError as refusal:
        warnings.error(str(refusal))
        return None
    trials = collector.trials
    if len(trials) != 1 or not _same(trials[0], trial):
        warnings.error('A session cannot record this order of steps: take a photograph between the '
                       'movements, and make each a trial of its own.')
        return None
    return replace(trials[0], name=trial.name)


def _same(recorded: Trial, trial: Trial) -> bool:
    """Tell whether a recorded trial has all hands and grips of a trial, and the same hands at the goal."""
    paths, expected = ({(hand.name, hand.grips, round(hand.start, 6), round(hand.end, 6))
                        for hand in source.hands} for source in (recorded, trial))
    return expected <= paths and recorded.goals[0].stable and (
        set(recorded.goals[0].held_by) == set(trial.goals[0].held_by))


@dataclass(frozen=True, eq=False)
class Drafts:
    """
    The measurements and trials of a document.

    :param photographs: the measurement of each photograph, by its id.
    :param trials: in the order of the document.
    :param mass: of the DLO [kg]; 0: unknown.
    :param placed: the obstacles, or why they cannot be placed, in the order of the document.
    :param filmed_diameter: diameter of the DLO as a film shows it [m]; None: none does.
    """

    photographs: Mapping[str, Measurement]
    trials: tuple[TrialDraft, ...]
    mass: float = 0.0
    placed: tuple[PlacedObstacle, ...] = ()
    filmed_diameter: float | None = None

    @cached_property
    def complete(self) -> tuple[Trial, ...]:
        """The complete trials, with the names that a session gives them."""
        trials = [draft.trial for draft in self.trials if draft.trial is not None]
        return tuple(replace(trial, name=f'trial {number}') for number, trial in enumerate(trials, start=1))

    @cached_property
    def digest(self) -> str:
        """Digest of the trials, their options and the obstacles."""
        return digest(tuple(draft.trial for draft in self.trials), self.options, *self.obstacles)

    @cached_property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles, without those that cannot be placed."""
        return tuple(placed for placed in self.placed if isinstance(placed, Obstacle))

    @property
    def diameter(self) -> float | None:
        """Diameter of the DLO [m]; None: neither given nor measured yet."""
        measured = next((photograph.thickness for photograph in self.photographs.values()), None)
        return self.filmed_diameter if measured is None else measured

    @property
    def options(self) -> dict[str, Any]:
        """The options of these trials, by name."""
        hang = [draft.hangs for draft in self.trials]
        only_hangs = bool(hang) and all(hang)
        errors = PHOTOGRAPH_ERRORS
        if self.filmed_diameter is not None:
            errors = FILM_ERRORS
        elif only_hangs:
            errors = {}
        options = measured_options(self.diameter, with_ends(self.mass) if only_hangs else self.mass,
                                   errors=errors)
        return {**options, 'nodes': NODES} if any(hang) else options

    def plain(self) -> dict[str, Any]:
        """Return the drafts as plain values, for the page."""
        return {'photographs': {name: {**photograph.plain, 'obstacles': self._outlines(photograph)}
                                for name, photograph in self.photographs.items()},
                'trials': [draft.plain for draft in self.trials],
                'obstacles': [{'sizes': None, 'problem': str(placed)} if isinstance(placed, InputError) else
                              {'sizes': numbers(placed.sizes, 6), 'problem': None} for placed in self.placed]}

    @cached_property
    def _lines(self) -> list[Floats]:
        """The lines around top and foot of the obstacles, each (n, 3) [m]."""
        return [line for obstacle in self.obstacles for line in lines_around(obstacle)]

    def _outlines(self, photograph: Measurement) -> list[Any]:
        """Return the lines around the obstacles as pixels of a photograph; none without a scale."""
        scale = photograph.scale
        return [] if scale is None else [numbers(line) for line in seen_lines(self._lines, scale)]


class Drafter:
    """Drafts the trials of a project's document; it belongs to one thread."""

    def __init__(self, project: Project) -> None:
        self._project = project
        self._measurer = Measurer(project)
        self._drafts: dict[int, tuple[tuple[object, ...], TrialDraft]] = {}

    def prepare(self, photograph: str) -> None:
        """
        Prepare a photograph, given by its id, for its first trace.

        :raises InputError: where it cannot be read.
        """
        self._measurer.tracer(photograph)

    def draft(self) -> Drafts:
        """Return the drafts of the present document."""
        document = self._project.document
        photographs = self._measurer.measure(document)
        before, self._drafts = self._drafts, {}
        goal: str | None = None
        held_in_goal: tuple[Hold, ...] = ()  # of the trial before
        for number, entry in enumerate(document.trials, start=1):
            held = held_in_goal if entry.start == goal else ()
            key = entry, held, *(photographs[identity] for identity in entry.photographs)
            same = number in before and before[number][0] == key
            self._drafts[number] = before[number] if same else (
                key, draft_trial(number, entry, photographs, held))
            goal, held_in_goal = entry.goal, held_after(entry.steps, held)
        return Drafts(photographs, tuple(draft for _, draft in self._drafts.values()), document.dlo.mass,
                      place_obstacles(document, photographs))


def measured_options(diameter: float | None, mass: float = 0.0, *, errors: Mapping[str, float]
                     ) -> dict[str, Any]:
    """
    Return the options of trials that a camera observed, by name.

    The table is the plane of the scale; the search for the radius begins at the measured one.

    :param diameter: of the DLO [m]; None: unknown.
    :param mass: of the DLO [kg]; 0: unknown.
    :param errors: slow errors of what the camera showed, by the names of their options; may be empty.
    """
    options: dict[str, Any] = {'table': True, 'table_height': 0.0, 'mass': mass, **errors}
    if diameter is not None:
        value = BY_NAME['self_collision'].value(diameter / 2)
        options['self_collision'] = min(max(value, 0.0), SCALE)
    return Options.of(options).flat()


def write_session(path: Path, trials: Sequence[Trial], options: Mapping[str, Any]) -> None:
    """
    Write trials to one MCAP file, as a robot's session.

    :param options: by name, to be recorded.
    :raises InputError: where the file cannot be written.
    """
    write_records(path, trial_records(trials), options)


def write_request(path: Path, trials: Sequence[Trial], options: Mapping[str, Any]) -> None:
    """
    Write trials to an XML request.

    :param options: by name.
    :raises InputError: where there is no trial, or the file cannot be written.
    """
    write_document(path, Request(tuple(map(TrialRequest.of, trials)), FileOptions(recordable(options))))
