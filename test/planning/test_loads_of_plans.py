# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What the DLO bears in the actions of predictions and plans, and plans that keep to what it may bear."""

from dataclasses import replace

from made_up_dlo import arc, LENGTH, MadeUpDlo, ROPE, straight
import numpy as np
import pytest
from soft_simulator import follow, SoftSimulator

from dlo_calibration import Action, Chain, Hand, Options
from dlo_calibration.model.named_actions import GraspAndPlace, LiftAndHold
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.planning.action_loads import plain_loads
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import plain_plan
from dlo_calibration.planning.planner import plan
from dlo_calibration.planning.prediction import plain_prediction, simulate
from dlo_calibration.simulation.loads import Loads

DLO = MadeUpDlo()
QUICK = Options(nodes=25, time_step=0.004)
ONE = PlanOptions(workers=1, draws=2, actions=1)
FOLDED = GraspAndPlace(point=0, to=(0.42, 0.1, 0.004))  # lays the first third beside the rest


def test_a_prediction_tells_the_loads_of_each_action_with_their_intervals():
    lifted = LiftAndHold(point=0, height=0.8, speed=0.2)
    dropped = Action((Hand('other', (20,), [8.0, 8.5], [(0.0, 0.0, 0.3)] * 2),))
    steps = simulate(DLO, straight(), [lifted, dropped], draws=4).steps
    hanging, falling = (step.loads for step in steps)
    assert 0.03 * GRAVITY < hanging.most_tension < 1.5 * 0.03 * GRAVITY  # it swings
    assert hanging.places[1] == 0.0
    assert hanging.most_strain == pytest.approx(hanging.most_tension / Posterior.of(DLO).best['elasticity'],
                                                rel=0.05)
    assert falling.least_bend_radius < 0.1
    for loads in (hanging, falling):
        assert (loads.lower <= loads.most).all() and (loads.most <= loads.upper).all()
        (sharp, wide), *_ = loads.ends
        assert sharp <= loads.least_bend_radius <= wide


def test_loads_become_json_and_the_radius_of_a_straight_dlo_is_null():
    prediction = simulate(DLO, straight(), [FOLDED], draws=2)
    action, = plain_prediction(prediction)['actions']
    loads = prediction.steps[0].loads
    assert action['least_bend_radius_m'] == loads.least_bend_radius == 1 / loads.most[0]
    assert action['most_tension_n'] == loads.most_tension and action['most_strain'] == loads.most_strain
    for key, unit in (('least_bend_radius', '_m'), ('most_tension', '_n'), ('most_strain', '')):
        assert 0 <= action[f'{key}_at_m'] <= LENGTH
        lower, upper = action[f'{key}_lower_upper{unit}']
        assert lower <= action[f'{key}{unit}'] <= upper
    none = replace(loads, most=np.zeros(3), lower=np.zeros(3), upper=np.zeros(3))
    assert none.least_bend_radius == np.inf
    assert set(plain_loads(None).values()) == {None}
    without = plan(DLO, straight(), Chain(follow(straight().points, 8, (0.0, 0.05))), ONE,
                   make_simulator=lambda _: SoftSimulator())
    assert plain_plan(without)['actions'][0]['most_tension_n'] is None


@pytest.mark.long
def test_a_plan_bends_the_dlo_no_more_sharply_than_permitted():
    goal = Chain(simulate(DLO, straight(), [FOLDED], options=QUICK, draws=0).steps[0].chain)
    free = plan(DLO, straight(), goal, ONE, simulation=QUICK)
    sharpest = free.actions[0].loads.least_bend_radius
    assert free.reached and 0.01 < sharpest < 0.1
    permitted = plan(DLO, straight(), goal, replace(ONE, least_bend_radius=0.8 * sharpest), simulation=QUICK)
    assert permitted.reached and permitted.actions[0].loads.least_bend_radius >= 0.8 * sharpest
    limit = 2 * sharpest
    gentle = plan(DLO, straight(), goal, replace(ONE, least_bend_radius=limit), simulation=QUICK)
    assert not gentle.reached and gentle.error_after > free.error_after
    for action in gentle.actions:
        assert action.loads.least_bend_radius >= limit
        seen = simulate(DLO, straight(), [action.action], options=QUICK, draws=0).steps[0].loads
        assert seen.least_bend_radius == pytest.approx(action.loads.least_bend_radius)
    words = f'the DLO is bent more sharply than least_bend_radius, {1e3 * limit:g} mm'
    assert any(words in warning for warning in gentle.warnings)


@pytest.mark.long
def test_a_plan_pulls_no_harder_than_permitted():
    goal = Chain(simulate(DLO, straight(), [FOLDED], options=QUICK, draws=0).steps[0].chain)
    free = plan(DLO, straight(), goal, ONE, simulation=QUICK)
    hardest = free.actions[0].loads.most_tension
    assert free.reached and 0.02 < hardest < 0.03 * GRAVITY
    for share, reached in ((1.2, True), (0.5, False)):
        result = plan(DLO, straight(), goal, replace(ONE, most_tension=share * hardest), simulation=QUICK)
        assert result.reached is reached
        assert all(action.loads.most_tension <= share * hardest for action in result.actions)
    assert any('pulled harder than most_tension' in warning for warning in result.warnings)


class Heavy(SoftSimulator):
    """In some parameter sets, the DLO bears 3 N, in the others 1 N."""

    def __init__(self, heavy):
        super().__init__()
        self._heavy = heavy

    def simulate(self, trial, physical):
        tension = 3.0 if physical['friction'] in self._heavy else 1.0
        most = np.tile((1.0, tension, 0.01), (len(trial.goals), 1))
        return replace(super().simulate(trial, physical),
                       loads=Loads(most, np.zeros_like(most)) if trial.loads else None)


@pytest.mark.parametrize(('draws', 'heavy', 'planned'), [
    (20, 2, True), (20, 3, False), (10, 1, True), (10, 2, False), (8, 0, True), (8, 1, False)])
def test_a_plan_may_pass_a_limit_in_one_draw_out_of_ten(draws, heavy, planned):
    dlo = MadeUpDlo({**ROPE, 'friction': (70.0, 55.0, 85.0)})
    frictions = [draw['friction'] for draw in Posterior.of(dlo).draws(draws, ONE.seed)]
    goal = Chain(follow(straight().points, 8, (0.0, 0.05)))
    result = plan(dlo, straight(), goal, replace(ONE, draws=draws, most_tension=2.0),
                  make_simulator=lambda _: Heavy(frictions[:heavy]))
    assert result.reached is planned and bool(result.actions) is planned
    if planned:
        _, (lower, upper), _ = result.actions[0].loads.ends
        assert lower == 1.0 and upper == pytest.approx(3.0 if heavy > 1 else 1.0, abs=2.0)
    else:
        assert any('pulled harder than most_tension, 2 N' in warning for warning in result.warnings)


def test_a_limit_that_start_and_goal_pass_already_is_told():
    bent = arc(3.0)
    goal = Chain(bent.points + (0.0, 0.05, 0.0))
    result = plan(DLO, bent, goal, replace(ONE, least_bend_radius=1.0), simulation=QUICK)
    assert not result.actions
    told = 'the DLO is bent more sharply than least_bend_radius, 1000 mm'
    assert f'at the start already, {told}, so no action is permitted' in result.warnings
    assert f'exactly on the goal, {told}' in result.warnings
