# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Weigh a rope that hands feel: its mass and stiffnesses from chains and forces.

    python examples/felt_rope.py

A simulated robot lifts a rope and pulls it taut, and measures the forces on its hands with a noise of 0.02 N.
Nobody tells the calibration how heavy the rope is.
"""

from dataclasses import replace

import numpy as np

from dlo_calibration import Action, calibrate, Chain, Force, Goal, Hand, Options, Trial
from dlo_calibration.simulation.compiled import CompiledSimulator

ROPE = {'mass': 0.045, 'flexibility': 2e-3, 'elasticity': 60.0, 'friction': 0.5, 'self_collision': 0.004,
        'damping': 0.3, 'internal_damping': 2e-3}  # SI units
LYING = np.column_stack([np.linspace(0, 0.6, 21), np.zeros(21), np.full(21, 0.004)])


def observed(name: str, ways: dict[int, tuple[float, float, float]], dice: np.random.Generator) -> Trial:
    """Return what the robot observes when its hands move points of the rope, each by its way [m]."""
    hands = tuple(Hand(f'hand_{point}', (point,), (0.0, 2.0), LYING[point] + np.outer((0, 1), way))
                  for point, way in ways.items())
    names = tuple(hand.name for hand in hands)
    wanted = tuple(Force(hand, np.zeros(3)) for hand in names)
    goal = Goal(Chain(LYING), 3.0, held_by=names, forces=wanted)
    trial = Trial(name, Chain(LYING), (Action(hands),), (goal,))
    reality = CompiledSimulator(nodes=81, time_step=1e-3).simulate(trial, ROPE)
    initial, shown = (Chain(points + dice.normal(0, 1e-3, LYING.shape))
                      for points in (LYING, reality.chains[0]))
    goal = replace(
        goal, chain=shown, forces=tuple(replace(force, vector=vector + dice.normal(0, 0.02, 3))
                     for force, vector in zip(wanted, reality.forces, strict=True)))
    return replace(trial, initial=initial, goals=(goal,))


def main() -> None:
    """Observe three trials, calibrate, and print what was found beside the truth."""
    dice = np.random.default_rng(1)
    trials = (observed('one end', {0: (0.1, 0.0, 0.25)}, dice),
              observed('both ends', {0: (0.1, 0.0, 0.3), 20: (-0.1, 0.0, 0.3)}, dice),
              observed('taut', {0: (-0.03, 0.0, 0.3), 20: (0.03, 0.0, 0.3)}, dice))
    result = calibrate(trials, Options(seed=1, workers=1))
    for name in ('mass', 'flexibility', 'elasticity'):
        found = result.parameters[name]
        print(f'{name}: {found.physical_value:.4g} {found.physical_unit} '
              f'({found.physical_lower:.4g} to {found.physical_upper:.4g}); truth {ROPE[name]:g}')


if __name__ == '__main__':
    main()
