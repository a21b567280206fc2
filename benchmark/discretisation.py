# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure the discretisation error of the engine, on reference objects with their true properties.

    python benchmark/discretisation.py

Nothing is fitted, and the chains have no noise: the remaining error is the difference
from the fine rod (101 nodes, 0.5 ms) that the objects were made with.
The table is printed, and written to benchmark/results/discretisation.md.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.model.parameters import PARAMETERS
from dlo_calibration.model.score import PointErrors, residuals
from dlo_calibration.simulation.compiled import CompiledSimulator

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get('DLO_DATA', HERE.parent / '../shared/data')) / 'reference'
#: nodes, time step [s], internal damping [s] (None: the default)
CASES = ((41, 0.003, None), (41, 0.004, None), (41, 0.002, None),
         (31, 0.004, None), (31, 0.004, 0.004), (31, 0.008, None), (31, 0.002, None),
         (61, 0.004, None), (61, 0.002, None), (61, 0.001, None))


def exact_trials(name: str) -> tuple[dict[str, float], list[Trial]]:
    """Return the properties and the nine noiseless trials of an object."""
    document = json.loads((DATA / f'{name}.json').read_text())
    trials = []
    for recorded in document['trials']:
        hands = tuple(Hand(f'hand{k}', (hand['grip_index'],), [knot['t'] for knot in hand['knots']],
                           [knot['position'] for knot in hand['knots']])
                      for k, hand in enumerate(recorded['hands']))
        held = () if recorded['release'] else tuple(hand.name for hand in hands)
        trials.append(Trial(recorded['action'], Chain(recorded['initial_exact']), (Action(hands),),
                            (Goal(Chain(recorded['goal_exact']), recorded['goal_time'], held_by=held),)))
    return document['properties'], trials


def main() -> None:
    """Make the table."""
    objects = [exact_trials(f'object{k}') for k in range(1, 6)]
    rows = ['| nodes | time step, ms | internal damping, ms | mean point error of 45 trials, mm '
            '| worst trial, mm |',
            '|---|---|---|---|---|']
    for nodes, step, damping in CASES:
        simulator = CompiledSimulator(nodes=nodes, time_step=step)
        errors = []
        for properties, trials in objects:
            physical = {p.name: p.physical(p.default) for p in PARAMETERS}
            physical.update(flexibility=properties['EI'], elasticity=properties['EA'],
                            friction=properties['mu'], self_collision=properties['radius'],
                            mass=properties['mass'])
            if damping is not None:
                physical['internal_damping'] = damping
            errors += [PointErrors.of(residuals(trial, simulator.simulate(trial, physical).chains)).mean
                       for trial in trials]
        simulator.close()
        rows.append(f'| {nodes} | {step * 1e3:g} | {physical["internal_damping"] * 1e3:.2g} '
                    f'| {np.mean(errors) * 1e3:.2f} | {np.max(errors) * 1e3:.2f} |')
        print(rows[-1], flush=True)
    text = '# discretisation\n\n`python benchmark/discretisation.py`\n\n' + '\n'.join(rows) + '\n'
    target = HERE / 'results' / 'discretisation.md'
    target.parent.mkdir(exist_ok=True)
    target.write_text(text)


if __name__ == '__main__':
    main()
