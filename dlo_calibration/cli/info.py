# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `info`: shows what a session contains."""

from __future__ import annotations

import argparse
from typing import Any

from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.cli.arguments import add_source, selected
from dlo_calibration.cli.output import print_json, standard_output
from dlo_calibration.messages.codec import ACTION, GOAL, INITIAL, INPUT_TYPES, WRENCH
from dlo_calibration.model.trial import Trial
from dlo_calibration.workspace.source import read_source, Source

add_arguments = add_source


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    from dlo_calibration.report import terminal

    about = _about(read_source(selected(chosen), lambda text: None, any_topics=True))
    if chosen.json:
        print_json(about)
    else:
        with standard_output() as stream:
            terminal.print_info(about, stream)
    return 0


def _about(source: Source) -> dict[str, Any]:
    """Return what a session contains, as plain values."""
    evidence = source.evidence
    choice, recorded = choose(source.trials, source.options, evidence), source.session.file_options
    used = {trial.name for trial in evidence.usable(source.trials)}
    return {
        'session': str(source.path), 'duration_s': source.session.duration,
        'frames': list(source.session.frames),
        'messages': dict(sorted(source.session.counts.items())),
        'unknown_topics': [_about_topic(topic, kind, source.session.counts[topic])
                           for topic, kind in source.session.others.items()],
        'options': None if recorded is None else dict(recorded.values),
        'calibrate': list(choice.options.calibrate), 'choice': choice.words,
        'trials': [{**_about_trial(number, trial), 'used': trial.name in used}
                   for number, trial in zip(source.numbers, source.trials, strict=True)],
        'refusals': list(source.refusals), 'notes': list(source.notes),
        'problems': [*source.session.warnings, *source.trial_warnings]}


def _about_topic(topic: str, kind: str, count: int) -> dict[str, Any]:
    """Describe a topic that the calibrator does not know, with a hint which input it could be."""
    fits = [name for name, needed in INPUT_TYPES.items() if needed == kind]
    has = {ACTION: 'the actions', WRENCH: 'the forces on a hand'}
    hint = ''.join(f'if {topic} has {words}, add --remap {topic}:={name}'
                   for name, words in has.items() if name in fits)
    if GOAL in fits:
        hint = f'if {topic} has the chains after the actions, add --remap {topic}:={GOAL}; if it has those ' \
               f'before them, {topic}:={INITIAL}'
    return {'topic': topic, 'type': kind, 'messages': count, 'hint': hint}


def _about_trial(number: int, trial: Trial) -> dict[str, Any]:
    chains = [trial.initial, *(goal.chain for goal in trial.goals)]
    return {
        'number': number, 'name': trial.name, 'points': len(trial.initial), 'length_m': trial.initial.length,
        'hands': [{'name': hand.name, 'grips': list(hand.grips), 'offset': hand.offset,
                   'waypoints': len(hand.times),
                   'start_s': hand.start, 'end_s': hand.end} for hand in trial.hands],
        'actions': len(trial.actions), 'goals': len(trial.goals),
        'stable_goals': sum(goal.stable for goal in trial.goals),
        'averaged_chains': sum(goal.count for goal in trial.goals if goal.count > 1),
        'timed_goals': sum(not goal.stable for goal in trial.goals),
        'duration_s': max(trial.goals[-1].time, *(hand.end for hand in trial.hands)),
        'moving_start': trial.velocity is not None,
        'forces': len(trial.forces),
        'unseen_points': int(sum((~chain.seen).sum() for chain in chains)),
        'annotated_hands': any(chain.hands is not None for chain in chains),
        'annotated_features': int(sum(chain.features.sum() for chain in chains))}
