# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `info`: shows what a session contains."""

from __future__ import annotations

import argparse
from typing import Any

from dlo_calibration.calibration.automatic import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.cli.output import print_json, standard_output
from dlo_calibration.cli.source import add_source, read_source, Source
from dlo_calibration.model.trial import Trial

TEXT = 'show what a session contains'
add_arguments = add_source


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    from dlo_calibration.report import terminal

    about = _about(read_source(chosen, lambda text: None))
    if chosen.json:
        print_json(about)
    else:
        with standard_output() as stream:
            terminal.print_info(about, stream)
    return 0


def _about(source: Source) -> dict[str, Any]:
    """Return what a session contains, as plain values."""
    choice = choose(source.trials, source.options)
    return {
        'session': str(source.path), 'duration_s': source.session.duration,
        'frames': list(source.session.frames),
        'messages': dict(sorted(source.session.counts.items())),
        'options': source.session.recorded, 'calibrate': list(choice.options.calibrate),
        'choice': choice.words,
        'trials': [_about_trial(trial) for trial in source.trials],
        'refusals': list(source.refusals), 'problems': list(source.session.problems)}


def _about_trial(trial: Trial) -> dict[str, Any]:
    chains = [trial.initial, *(goal.chain for goal in trial.goals)]
    return {
        'name': trial.name, 'points': len(trial.initial), 'length_m': trial.initial.length,
        'hands': [{'name': hand.name, 'grips': list(hand.grips), 'waypoints': len(hand.times),
                   'start_s': hand.start, 'end_s': hand.end} for hand in trial.hands],
        'actions': len(trial.actions), 'goals': len(trial.goals),
        'stable_goals': sum(goal.stable for goal in trial.goals),
        'timed_goals': sum(not goal.stable for goal in trial.goals),
        'duration_s': max(trial.goals[-1].time, *(hand.end for hand in trial.hands)),
        'moving_start': trial.velocity is not None,
        'annotated_hands': any(chain.hands is not None for chain in chains),
        'annotated_features': int(sum(chain.features.sum() for chain in chains))}
