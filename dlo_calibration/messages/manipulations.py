# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Manipulations from messages: the initial chain of a trial and its actions, with or without goal chains."""

from __future__ import annotations

from typing import Union

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import ActionMessage
from dlo_calibration.messages.trial_builder import (
    annotated_grips,
    instants_of,
    order,
    seconds,
    TrialBuilder,
)
from dlo_calibration.model.action import Action
from dlo_calibration.model.manipulation import in_steps, Manipulation, RecordedPaths, Timed


def manipulation_of(builder: TrialBuilder, name: str,
                    options: Options) -> tuple[Manipulation | None, list[InputError]]:
    """
    Return what the hands of a trial did, whether or not it has a goal chain.

    A goal chain only tells which hands hold the DLO.  Without an annotation, a hand grips the nearest
    place of the latest chain, if no action has moved the DLO since, else of the predicted chain.

    :param options: `grip_tolerance` and `release` are used.
    :returns: None if there is no usable action; and the reasons why actions are not used.
    """
    refused = [(one, error) for one, error in builder.refused if isinstance(one, ActionMessage)]
    messages = sorted([*(move.message for move in builder.moves), *(one for one, _ in refused)], key=order)
    if not messages or not builder.starts:
        return None, [error for _, error in refused]
    accepted = {order(move.message): move for move in builder.moves}
    zero = min(instants_of(one)[0] for one in messages)
    ends: list[int] = []
    found, problems = [], []
    for message in messages:
        instants = instants_of(message)
        seen = max([builder.starts[-1].stamp, *(view.message.stamp for view in builder.views
                                                if view.message.stamp <= instants[0])])
        action: Union[Action, RecordedPaths, None] = None
        if any(seen < end <= instants[0] for end in ends):
            action = _recorded(builder, message, float(seconds(instants, zero)[0]), options)
        elif order(message) in accepted:
            action = accepted[order(message)].action(zero)
        if action is None:
            problems += [error for one, error in refused if one is message]
            continue
        ends.append(instants[-1])
        found.append(Timed(action, float(seconds(instants, zero)[-1]), not options.release))
    if not found:
        return None, problems
    told = [(float(seconds([view.message.stamp], zero)[0]),
             None if view.message.chain.hands is None else view.held_by) for view in builder.views]
    return in_steps(name, builder.starts[-1].chain, found, told), problems


def _recorded(builder: TrialBuilder, message: ActionMessage, start: float, options: Options) -> RecordedPaths:
    """Return an action that begins after another one has moved the DLO, at `start` [s]."""
    chain, numbered = builder.starts[-1].chain, message.names
    views = [view for view in builder.views if order(view.message) < order(message)]
    if views:
        chain, numbered = views[-1].message.chain, views[-1].names
    return RecordedPaths(
        start=start, hands=message.names, grips=tuple(annotated_grips(chain, numbered, message.names)),
        times=message.times - message.times[0], positions=message.positions,
        orientations=message.orientations, tolerance=options.grip_tolerance)
