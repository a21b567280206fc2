# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Calibrations on trials with unseen points."""

from contextlib import closing
from dataclasses import replace

from fitted import fitted
import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import Action, Chain, Goal, Hand, Options, Trial
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.fit import fit
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.report.drawing import Drawn, trial_panels
from dlo_calibration.search import SEARCHES

FLEXIBILITY = 68.8
POINTS = 16


def tracked(points, random, share, ends=False):
    """Return a chain with noise and a share of unseen points; with `ends`, both ends are seen."""
    hidden = random.choice(np.arange(ends, POINTS - ends), round(share * POINTS), replace=False)
    seen = points + random.normal(0, 2e-4, points.shape)
    seen[hidden] = np.nan
    return Chain(seen)


def lifted(simulator, space, share):
    """Return a trial of a DLO whose flexibility is FLEXIBILITY."""
    random, x = np.random.default_rng(2), np.linspace(0, 0.6, POINTS)
    start = np.stack([x, 0.04 * np.sin(10 * x), np.full(POINTS, 0.005)], axis=1)
    path = start[4] + [[0, 0, 0], [0, 0, 0.08], [0.05, 0.1, 0.08]]
    hand = Hand('hand', (4,), [0.0, 1.0, 2.5], path)
    trial = Trial('lift', Chain(start), (Action((hand,)),), (Goal(Chain(start), 4.0, held_by=('hand',)),))
    physical = space.physical({'flexibility': FLEXIBILITY}, trial.initial.length)
    end, = simulator.simulate(trial, physical).chains
    return replace(trial, initial=tracked(start, random, share, True),
                   goals=(replace(trial.goals[0], chain=tracked(end, random, share)),))


def test_a_parameter_is_recovered_despite_unseen_points():
    space = ParameterSpace(('flexibility',), {'friction': 40.0})
    with closing(make_simulator(Options.of({'engine': 'compiled'}))) as simulator:
        for share in (0.0, 0.1):
            trial = lifted(simulator, space, share)
            assert (~trial.initial.seen).sum() == (~trial.goals[0].chain.seen).sum() == round(share * POINTS)
            result = fit(Setting((trial,), Options(), simulator), space, SEARCHES['least_squares'](1, 1), 10)
            assert result.best.values['flexibility'] == pytest.approx(FLEXIBILITY, abs=1.0)
            assert result.best.errors.mean < 2e-3


def test_a_result_shows_whole_simulated_chains_and_only_the_seen_measured_points():
    truth = {'flexibility': 40.0, 'elasticity': 65.0, 'friction': 25.0, 'self_collision': 55.0}
    whole = toy_trial(truth, n=15)
    points = whole.goals[0].chain.points.copy()
    points[[3, 9]] = np.nan
    trial = replace(whole, goals=(replace(whole.goals[0], chain=Chain(points)),))
    result = fitted([trial, toy_trial(truth, 'trial 2', turn=1.0)], ParameterSpace(), ToySimulator(),
                    SEARCHES['random'](4, 1), budget=5)
    simulated = ToySimulator().simulate(trial, ParameterSpace().physical(result.best.values, result.length))
    np.testing.assert_allclose(result.chains[0], simulated.chains, atol=0.01)
    np.testing.assert_allclose(result.chains[0][:, :3], simulated.chains[:, :3], atol=1e-12)
    assert all(panel for panel in trial_panels(Drawn.of(result, 0)))
