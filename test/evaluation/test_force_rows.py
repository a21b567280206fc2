# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Where the residuals of forces stand among those of points."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Force, Goal, Hand, Trial
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.evaluation.residuals import compared_goals, compared_rows, ResidualLayout
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.protocol import Rollout

POINTS = np.column_stack([np.linspace(0, 0.4, 5), np.zeros((5, 2))])
HELD = ('left',)


def trial(name, count, felt, tared=True):
    """Return a trial with `count` goals in motion; the k-th of those in `felt` has the force (k, 0, 0)."""
    hand = Hand('left', (0,), (0.0, 100.0), np.zeros((2, 3)))
    seen = np.arange(5) != 3
    goals = tuple(Goal(Chain(POINTS, seen=seen), 1.0 + k, False, HELD, forces=(
        Force('left', np.array([k, 0, 0]), tared),) if k in felt else ()) for k in range(count))
    return Trial(name, Chain(POINTS), (Action((hand,)),), goals)


class Felt:
    """It leaves the DLO where it is, and pulls with 10 N up."""

    name = 'felt'

    def simulate(self, trial, physical):
        """Return that."""
        count = len(trial.goals)
        return Rollout(np.repeat(POINTS[None], count, axis=0), (True,) * count, 1.0, 1,
                       forces=np.tile([0.0, 0, 10], (len(trial.forces), 1)))


def residuals(trials):
    evaluator = Evaluator(trials, ParameterSpace(('flexibility',)), Felt())
    return evaluator.evaluate(0, np.array([0.5])).residuals


def test_forces_follow_the_points_of_their_trial():
    trials = [trial('a', 2, {1}), trial('b', 1, {}), trial('c', 1, {0})]
    layout, values = ResidualLayout.of(trials), residuals(trials)
    assert [rows.stop - rows.start for rows in layout.rows] == [2 * 12 + 3, 12, 12 + 3]
    scale = trials[0].force_scale[0]
    np.testing.assert_allclose(values[layout.force_rows[0]], scale * np.array([-1, 0, 10]))
    np.testing.assert_allclose(values[layout.force_rows[2]], scale * np.array([0, 0, 10]))
    assert not layout.points(values).any()
    assert len(layout.points(values)) == 4 * 12
    assert len(layout.points(values, layout.rows[2])) == 12
    assert [len(block) for block in layout.aligned(values)] == [2 * 15 + 3, 15, 15 + 3]
    assert layout.without(0).rows == [slice(0, 12), slice(12, 27)]


def test_an_unknown_offset_leaves_only_differences():
    trials = [trial('a', 3, {0, 2}, tared=False)]
    values = residuals(trials)[ResidualLayout.of(trials).force_rows[0]].reshape(-1, 3)
    np.testing.assert_allclose(values / trials[0].force_scale, [(1, 0, 0), (-1, 0, 0)])


def test_search_compares_the_forces_of_the_goals_that_it_compares():
    trials = [trial('a', 80, set(range(0, 80, 3))), trial('b', 1, {0})]
    rows, every = compared_rows(trials), residuals(trials)
    chosen = compared_goals(trials[0])
    wanted = [k for k in range(0, 80, 3) if k in chosen]
    assert 0 < len(wanted) < 27
    layout = ResidualLayout.compared(trials)
    assert len(rows) == layout.rows[-1].stop
    np.testing.assert_allclose(every[rows][layout.force_rows[0]].reshape(-1, 3)[:, 0],
                               -trials[0].force_scale[0] * np.array(wanted))


@pytest.mark.parametrize('scale', [(0.1, 0.1, 0.1), (0.0, 1.0, 2.0)])
def test_a_scale_says_how_much_forces_count(scale):
    trials = [replace(trial('a', 1, {0}), force_scale=scale)]
    np.testing.assert_allclose(residuals(trials)[-3:], np.array([0, 0, 10]) * scale)
