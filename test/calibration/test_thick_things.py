# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Thick and stiff things, which the scale holds: a hose and a charging cable."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator


@pytest.mark.parametrize(('length', 'mass', 'bending', 'radius'), [
    pytest.param(2.0, 1.0, 2.0, 0.012, id='hose'), pytest.param(1.5, 0.9, 0.14, 0.01, id='20 mm cable')])
def test_the_stiffness_of_a_thick_thing_is_recovered(length, mass, bending, radius):
    values = {'elasticity': 8.0, 'self_collision': BY_NAME['self_collision'].value(radius)}
    physical = {**ParameterSpace(fixed=values, mass=mass).physical({}, length), 'flexibility': bending}
    along = np.linspace(0, length, 21)
    points = np.stack([along, 0.03 * length * np.sin(6 * along / length), 0 * along + radius], axis=1)
    way = points[0] + length * np.array([(0, 0, 0), (0.05, 0.1, 0.2)])
    hand = Hand('hand', (0,), np.array([0, 2 * length]), way)
    goal = Goal(Chain(points), 2 * length + 3, held_by=('hand',))
    trial = Trial('lift', Chain(points), (Action((hand,)),), (goal,))
    seen, = CompiledSimulator(nodes=61).simulate(trial, physical).chains
    noise = np.random.default_rng(1).normal(0, 3e-4 * length, seen.shape)
    result = calibrate([replace(trial, goals=(replace(goal, chain=Chain(seen + noise)),))], Options(
        mass=mass, engine='compiled', workers=1, calibrate=('flexibility',), values=values))
    found = result.parameters['flexibility']
    assert found.identifiable and not result.unusable
    assert found.physical_value == pytest.approx(bending, rel=0.05)
