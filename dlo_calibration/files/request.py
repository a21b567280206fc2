# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Request: an XML document with the object, the settings and the trials of a calibration.

The actions of a trial are named actions, or explicit paths of hands.  A named action
starts from the latest observed chain before it: the initial one, or a goal chain.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
import re
from typing import Any, Union

import numpy as np

from dlo_calibration.calibration.options import FileOptions, Options
from dlo_calibration.errors import InputError
from dlo_calibration.files import xml
from dlo_calibration.model.action import Action, Hand, MAXIMUM_TIME, NO_ROTATION, PATHS
from dlo_calibration.model.chain import Chain, Floats, frozen_array, length_change
from dlo_calibration.model.named_actions import (
    Manipulation,
    manipulation_of,
    NAMED_ACTIONS,
    NamedAction,
    TimedAction,
)
from dlo_calibration.model.parameters import SCALES
from dlo_calibration.model.pose import Pose
from dlo_calibration.model.trial import Force, Goal, Trial
from dlo_calibration.writing import write_file

WHAT = 'request'  # in errors
TURNS = ('qx', 'qy', 'qz', 'qw')  # attributes of a waypoint


@dataclass(frozen=True)
class GoalRequest:
    """
    A goal chain of a request.

    :param time: seconds since the start of the trial.
    :param stable: True: compared when the simulated DLO has come to rest; False: at that instant.
    :param held_by: names of the hands that hold the DLO; None: those that still hold it after the actions.
    :param forces: see `Goal`.
    """

    chain: Chain
    time: float
    stable: bool = True
    held_by: tuple[str, ...] | None = None
    forces: tuple[Force, ...] = ()


@dataclass(frozen=True)
class TrialRequest:
    """
    A trial of a request.

    :param actions: named actions, or explicit paths of hands.
    :param goals: may be empty: such a trial can be simulated, but shows no parameter.
    :param velocity: (n, 3) [m/s] of the initial points; None: at rest.
    """

    name: str
    initial: Chain
    actions: tuple[Union[NamedAction, Action], ...]
    goals: tuple[GoalRequest, ...]
    velocity: Floats | None = None

    def __post_init__(self) -> None:
        if self.velocity is not None:
            object.__setattr__(self, 'velocity', frozen_array(self.velocity))
        names = {name for action in self.actions for name in action.hand_names}
        names.update(name for goal in self.goals for name in goal.held_by or ())
        for name in names:
            # XML attributes can hold these characters, and a list of names has blanks between them.
            if not re.fullmatch(r'[^\s\x00-\x1f\ud800-\udfff\ufffe\uffff]{1,100}', name):
                raise InputError(f'trial {self.name!r}', f'a hand named {name!r}',
                                 'at most 100 characters without blanks', 'choose another name')
        if self.goals:
            self.trial()
        else:
            self.manipulation()

    @classmethod
    def of(cls, trial: Trial) -> TrialRequest:
        """Return the request for an observed trial."""
        goals = tuple(GoalRequest(goal.chain, goal.time, goal.stable, goal.held_by, goal.forces)
                      for goal in trial.goals)
        return cls(trial.name, trial.initial, trial.actions, goals, trial.velocity)

    def moved(self, pose: Pose) -> TrialRequest:
        """Return the trial in the table's frame, where `pose` is that of the request's frame."""
        return replace(
            self, initial=pose.chain(self.initial), actions=tuple(
                pose.action(action) if isinstance(action, Action) else pose.named_action(action)
                for action in self.actions),
            goals=tuple(replace(goal, chain=pose.chain(goal.chain), forces=pose.forces(goal.forces))
                        for goal in self.goals),
            velocity=None if self.velocity is None else pose.vectors(self.velocity))

    def trial(self, release: bool = True) -> Trial:
        """
        Return the trial, in which all actions are explicit paths of hands.

        :param release: True: hands on explicit paths open at their last waypoint, unless
            a goal names them in `held_by`.
        :raises InputError: where an action is impossible.
        """
        done: list[Action] = []
        holds = []
        for requested in self._in_order():
            if isinstance(requested, NamedAction):
                action, hold = requested.action(self._seen(requested.start), done), requested.hold
            else:
                action, hold = requested, not release
            done.append(action)
            holds.append(hold)
        goals = []
        for goal in self.goals:
            last = {name: hold for action, hold in zip(done, holds, strict=True) if action.end < goal.time
                    for name in action.hand_names}
            held_by = goal.held_by
            if held_by is None:
                held_by = tuple(name for name, hold in last.items() if hold)
            goals.append(Goal(goal.chain, goal.time, goal.stable, held_by, forces=goal.forces))
        return Trial(self.name, self.initial, tuple(done), tuple(goals), self.velocity)

    def manipulation(self, release: bool = True) -> Manipulation:
        """
        Return the manipulation; its named actions start from the predicted chain.

        :param release: as of `trial`.
        """
        done: list[Action] = []
        timed = []
        for action in self._in_order():
            end, hold = action.start, not release
            if isinstance(action, NamedAction):
                hold = action.hold
                with suppress(InputError):  # it may be possible with the predicted chain
                    done.append(action.action(self._seen(action.start), done))
                    end = done[-1].end
            else:
                done.append(action)
                end = action.end
            timed.append(TimedAction(action, end, hold))
        goals = sorted(self.goals, key=lambda goal: goal.time)
        manipulation = manipulation_of(self.name, self.initial, timed,
                                       [(goal.time, goal.held_by) for goal in goals])
        if self.velocity is None:
            return manipulation
        warning = f'trial {self.name!r}: the DLO begins at rest, not with the given velocity'
        return replace(manipulation, warnings=(*manipulation.warnings, warning))

    def _in_order(self) -> list[Union[NamedAction, Action]]:
        return sorted(self.actions, key=lambda action: action.start)

    def _seen(self, time: float) -> Chain:
        """Return the latest chain observed no later than a time [s]."""
        seen = [goal for goal in self.goals if goal.time <= time]
        return max(seen, key=lambda goal: goal.time).chain if seen else self.initial


@dataclass(frozen=True)
class Request:
    """
    The object, settings and trials of a calibration.

    :param file_options: the given options, including the mass [kg] if it is known.
    :param name: of the object.
    """

    trials: tuple[TrialRequest, ...]
    file_options: FileOptions = FileOptions()
    name: str | None = None

    def __post_init__(self) -> None:
        if not self.trials:
            raise InputError(WHAT, 'no trial', 'at least one', 'add a trial')
        Options.of(self.file_options.values)
        object.__setattr__(self, 'trials', tuple(self.trials))

    @cached_property
    def document(self) -> bytes:
        """The request as an XML document in UTF-8."""
        root = xml.new_root('calibration_request', version=SCALES)
        options = self.file_options.values
        settings = {name: value for name, value in options.items() if name != 'mass'}
        xml.add(root, 'object', name=self.name, mass=options.get('mass'))
        xml.add_options(root, 'settings', settings)
        for trial in self.trials:
            element = xml.add(root, 'trial', name=trial.name)
            xml.add_points(xml.add(element, 'initial_chain'), trial.initial)
            if trial.velocity is not None:
                velocity = xml.add(element, 'velocity')
                for x, y, z in trial.velocity.tolist():
                    xml.add(velocity, 'vector', x=x, y=y, z=z)
            for action in trial.actions:
                _add_action(element, action)
            for goal in trial.goals:
                observed = xml.add(element, 'goal_chain', time=goal.time, stable=goal.stable,
                                   held_by=goal.held_by)
                xml.add_points(observed, goal.chain)
                for force in goal.forces:
                    x, y, z = force.vector.tolist()
                    xml.add(observed, 'force', hand=force.hand, x=x, y=y, z=z, tared=force.tared)
        return xml.document(root)


def write_request(path: str | Path, request: Request) -> None:
    """
    Write a request to an XML file.

    :raises InputError: where the file cannot be written.
    """
    write_file(path, request.document)


def read_request(path: str | Path) -> Request:
    """
    Read a request file.

    :raises InputError: where the file cannot be read, or is not a valid request;
        the text names the line and the element.
    """
    octets = xml.read_octets(path, WHAT, 'a calibration request')
    return request_of(octets, f'{WHAT} {path}', Path(path).parent)


def request_of(octets: bytes, where: str = WHAT, folder: Path | None = None) -> Request:
    """
    Read a request from the bytes of its document.

    :param where: name of the document in errors.
    :param folder: of the document, in which its scene may lie.
    :raises InputError: where it is not a valid request.
    """
    root = xml.parse(octets, where, 'calibration_request')
    of_object, settings, *trials = root
    given = xml.read_options(where, settings, folder)
    options = dict(given.values)
    if 'mass' in options:
        raise xml.refused(where, settings, "an option 'mass'", 'the mass as an attribute of <object>',
                          'move it')
    if of_object.get('mass') is not None:
        options['mass'] = xml.number(where, of_object, 'mass')
        with xml.located(where, of_object):
            Options.of({'mass': options['mass']})
    with xml.located(where, settings):
        return Request(tuple(_trial(where, trial) for trial in trials), replace(given, values=options),
                       of_object.get('name'))


def request_trials(request: Request, options: Options) -> tuple[tuple[Trial, ...], tuple[str, ...]]:
    """
    Return the trials of a request, and the reasons why others are not used.

    :param options: `length_tolerance`, `release` and `frame_pose` are used.
    """
    trials, refusals, pose = [], [], options.pose
    for requested in request.trials:
        if not requested.goals:
            refusals.append(str(InputError(
                f'trial {requested.name!r}', 'no goal chain', 'at least one',
                'observe the DLO after the action, or predict it with dlo-calibration simulate')))
            continue
        trial = (requested if pose is None else requested.moved(pose)).trial(options.release)
        change = max(length_change(trial.initial, goal.chain) for goal in trial.goals)
        if change > options.length_tolerance:
            refusals.append(str(InputError(
                f'trial {trial.name!r}', f'a goal chain whose length differs by {change:.0f} %',
                f'at most {options.length_tolerance:g} % (length_tolerance)',
                'check that both chains run along the whole DLO, in metres')))
        else:
            trials.append(trial)
    return tuple(trials), tuple(refusals)


def request_manipulations(request: Request, options: Options) -> tuple[Manipulation, ...]:
    """
    Return the manipulation of each trial of a request, with or without goal chains.

    :param options: `release` and `frame_pose` are used.
    """
    pose = options.pose
    return tuple((requested if pose is None else requested.moved(pose)).manipulation(options.release)
                 for requested in request.trials)


def _add_action(parent: Any, action: Union[NamedAction, Action]) -> None:
    if isinstance(action, NamedAction):
        values = {part.name: getattr(action, part.name) for part in fields(action)}
        last = {name: values.pop(name) for name in ('start', 'hold')}  # where the schema has them
        xml.add(parent, action.name, **values, **last)
        return
    paths = xml.add(parent, PATHS)
    for hand in action.hands:
        element = xml.add(paths, 'hand', name=hand.name, grips=hand.grips, offset=hand.offset or None,
                          nearest=hand.nearest or None)
        turns = (hand.orientations != NO_ROTATION).any(axis=1)
        for time, (x, y, z), turn, turned in zip(hand.times.tolist(), hand.positions.tolist(),
                                                 hand.orientations.tolist(), turns, strict=True):
            xml.add(element, 'waypoint', time=time, x=x, y=y, z=z,
                    **(dict(zip(TURNS, turn, strict=True)) if turned else {}))


def _trial(where: str, element: Any) -> TrialRequest:
    goals = tuple(_goal(where, goal) for goal in element.findall('goal_chain'))
    velocity = element.find('velocity')
    actions = tuple(_action(where, child) for child in element
                    if child.tag == PATHS or child.tag in NAMED_ACTIONS)
    initial = xml.read_chain(where, element.find('initial_chain'))
    with xml.located(where, element):
        return TrialRequest(element.get('name'), initial, actions, goals,
                            None if velocity is None else xml.read_vectors(where, velocity))


def _goal(where: str, element: Any) -> GoalRequest:
    goal = GoalRequest(xml.read_chain(where, element), **xml.attributes(where, element, GoalRequest),
                       forces=tuple(_force(where, force) for force in element.findall('force')))
    if abs(goal.time) > MAXIMUM_TIME:
        raise xml.refused(where, element, f'a time of {goal.time:g} s', f'at most {MAXIMUM_TIME:g} s')
    return goal


def _force(where: str, element: Any) -> Force:
    with xml.located(where, element):
        return Force(vector=xml.read_vectors(where, [element])[0], **xml.attributes(where, element, Force))


def _action(where: str, element: Any) -> Union[NamedAction, Action]:
    with xml.located(where, element):
        if element.tag == PATHS:
            return Action(tuple(_hand(where, hand) for hand in element))
        kind = NAMED_ACTIONS[element.tag]
        return kind(**xml.attributes(where, element, kind))


def _hand(where: str, element: Any) -> Hand:
    turns = []
    for waypoint in element:
        given = [name for name in TURNS if waypoint.get(name) is not None]
        if given and len(given) < len(TURNS):
            raise xml.refused(where, waypoint, f'only {" ".join(given)}', 'all of qx qy qz qw, or none')
        turns.append([xml.number(where, waypoint, name) for name in TURNS] if given else NO_ROTATION)
    with xml.located(where, element):
        return Hand(times=np.array([xml.number(where, waypoint, 'time') for waypoint in element]),
                    positions=xml.read_vectors(where, element), orientations=np.array(turns, dtype=float),
                    **xml.attributes(where, element, Hand))
