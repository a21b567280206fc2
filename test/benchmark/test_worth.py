# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What calibration is worth: the execution of plans, their journals, and the tables."""

from concurrent.futures import CancelledError
import csv
from dataclasses import asdict, replace
import io
import json

import numpy as np
from PIL import Image
from plan_executions import (
    Belief,
    CalibrationTask,
    DEFAULT,
    execute,
    Execution,
    FITTED,
    learn,
    PlanOutcome,
    PlanTask,
    TRUE,
)
import pytest
from reality import KNOWN_DLOS
from worth import conduct_worth, WorthStudy
from worth_tables import ALL, executions_csv, markdown, picture, table_rows

from dlo_calibration import Action, Hand, InputError, read_session
from dlo_calibration.calibration.engines import make_simulator as make_real_simulator
from dlo_calibration.experiment.journal import Laboratory
from dlo_calibration.experiment.study import Observed
from dlo_calibration.files.session import samples
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import Plan, PlannedAction

ROPE = KNOWN_DLOS[0]
TRUTH = Belief.certain(TRUE, ROPE)
TASK = PlanTask(ROPE, TRUTH, 0, 1, PlanOptions(workers=1, draws=0), 'compiled')


def coarse(options):
    return make_real_simulator(replace(options, nodes=15, time_step=0.006))


class Nudging:
    """A planner whose plans drag the middle by 1 cm, `actions` times; it records its arguments."""

    def __init__(self, actions=2):
        self.actions = actions
        self.starts, self.goals, self.most = [], [], []

    def __call__(self, dlo, start, goal, options, *, simulation, should_stop):
        assert dlo.length == pytest.approx(ROPE.length, rel=0.01)
        assert simulation.mass == ROPE.mass
        self.starts.append(start.points)
        self.goals.append(goal.points)
        self.most.append(options.actions)
        place = start.points[10]
        planned = []
        for k in range(self.actions):
            path = place + np.array([[0, 0.01 * k, 0], [0, 0.01 * (k + 1), 0]])
            action = Action((Hand('hand_1', (10,), np.array([0.0, 0.1]), path),))
            planned.append(PlannedAction('drag', action, start.points, start.points, start.points))
        return Plan(start, goal, tuple(planned), 0.1, 0.012, 7.0, False, 0.006, 30, 1.0, 1, 'it is a test')


def test_a_plan_is_executed_blindly_and_replanned_after_each_action():
    planner = Nudging()
    done = execute(TASK, coarse, planner)
    assert done.failure == ''
    blind, seeing = done.open_loop, done.replanned
    assert (blind.actions, blind.plans, blind.rollouts) == (2, 1, 30)
    assert (seeing.actions, seeing.plans, seeing.rollouts) == (6, 6, 180)
    assert blind.errors[:2] == seeing.errors[:2]  # both begin with the same plan
    assert len(set(blind.errors)) == 3
    assert blind.predicted == pytest.approx(2.0)
    assert planner.most == [4, 4, 4, 3, 2, 1]
    assert all(goal is planner.goals[0] or (goal == planner.goals[0]).all() for goal in planner.goals)


def test_the_first_plan_knows_the_start_and_the_next_see_it_with_noise():
    planner = Nudging()
    done = execute(TASK, coarse, planner)
    distances = np.linalg.norm(planner.starts[0] - planner.goals[0], axis=1)
    assert 100 * distances.mean() / ROPE.length == pytest.approx(done.replanned.errors[0])
    heights = np.array([start[:, 2] - ROPE.radius for start in planner.starts])
    assert np.abs(heights[0]).max() < 1e-4
    assert heights[1:].std() == pytest.approx(1e-3, rel=0.3)


def test_replanning_ends_within_the_tolerance_or_without_an_action():
    done = execute(replace(TASK, options=PlanOptions(tolerance=90.0)), coarse, planner := Nudging())
    assert (done.replanned.actions, len(planner.starts)) == (1, 1)
    done = execute(TASK, coarse, Nudging(0))
    assert (done.open_loop.actions, done.replanned.actions, done.replanned.plans) == (0, 0, 1)


def test_a_planner_that_fails_is_an_outcome_and_a_stopped_one_is_none():
    def refusing(*_, **__):
        raise InputError('goal', 'this', 'that', 'do better')

    done = execute(TASK, coarse, refusing)
    assert (done.open_loop, done.replanned) == (None, None)
    assert 'do better' in done.failure
    with pytest.raises(CancelledError):
        execute(TASK, coarse, Nudging(), should_stop=lambda: True)


def test_a_belief_is_that_of_a_calibrated_dlo():
    truth = Posterior.of(TRUTH)
    assert truth.best == pytest.approx(ROPE.physical)
    assert truth.draws(2, 1) == [truth.best, truth.best]
    default = Posterior.of(Belief.certain(DEFAULT, ROPE)).best
    assert default['flexibility'] == BY_NAME['flexibility'].physical(65.4)
    assert default['mass'] == ROPE.mass
    session = read_session(samples() / ROPE.name)
    observed = Observed(session.trials[:2], replace(session.options, evaluations=20))
    belief = learn(CalibrationTask(ROPE, observed, 'compiled'), coarse)
    assert belief.kind == FITTED
    assert belief.intervals['friction'][0] == pytest.approx(ROPE.values['friction'], abs=15)
    assert Belief.of(json.loads(json.dumps(asdict(belief)))) == belief


def study(**changed):
    session = read_session(samples() / ROPE.name)
    observed = Observed(session.trials[:1], replace(session.options, evaluations=5))
    return replace(WorthStudy({ROPE: observed}, 1, 1, PlanOptions(workers=1), 'the command'), **changed)


@pytest.mark.long
def test_an_interrupted_experiment_continues_and_repeats_nothing(tmp_path):
    reports, planner = [], Nudging(1)

    def laboratory(stop=lambda: False):
        return Laboratory(tmp_path, 1, stop, reports.append, io.StringIO())

    text = conduct_worth(study(), laboratory(lambda: len(planner.starts) > 8), coarse, planner)
    assert '**Not complete**' in text
    assert '1 of 3 are done' in reports[-1]
    before = len(planner.starts)
    second = laboratory()
    text = conduct_worth(study(), second, coarse, planner)
    assert '**Not complete**' not in text
    assert len(planner.starts) - before == 2 * 6
    assert second.attempts.written == ['worth.md', 'worth.csv', 'worth.png']
    assert conduct_worth(study(), laboratory(), coarse, planner) == text
    assert len(planner.starts) - before == 2 * 6
    assert (tmp_path / 'worth.md').read_text() == text


def test_no_pairs_are_refused():
    with pytest.raises(InputError, match='--pairs'):
        study(pairs=0)


def outcome(error, way_error, score=10.0, missed=0):
    execution = Execution((20.0, error), (99.0, score), missed, 0.5, 1, 100, 2.0)
    return PlanOutcome(execution, replace(execution, errors=(20.0, 5.0, way_error), missed=0))


def made_up():
    done = []
    for kind, scale in ((FITTED, 1.2), (TRUE, 1.0), (DEFAULT, 2.0)):
        task = replace(TASK, belief=replace(TRUTH, kind=kind))
        done += [(replace(task, index=k), outcome(scale * (k + 1), 1.0, missed=k)) for k in range(3)]
        if kind != TRUE:
            done.append((replace(task, dlo=KNOWN_DLOS[1]), PlanOutcome(None, None, 'it failed')
                         if kind == FITTED else outcome(15.0, 15.0, score=80.0)))
    return done


def test_the_tables_compare_the_kinds_of_parameters():
    rows = {(row.subject, row.kind): row for row in table_rows(made_up(), 'open_loop')}
    assert list(rows) == [('object1', FITTED), ('object1', DEFAULT), ('object1', TRUE),
                           ('object2', DEFAULT), (ALL, FITTED), (ALL, DEFAULT), (ALL, TRUE)]
    fitted = rows['object1', FITTED]
    assert (fitted.pairs, fitted.median, fitted.worst) == pytest.approx((3, 2.4, 3.6))
    assert fitted.most == pytest.approx(np.percentile([1.2, 2.4, 3.6], 90))
    assert (fitted.near, fitted.similar, fitted.missed) == (pytest.approx(2 / 3), 1.0, 3)
    assert fitted.ratio == pytest.approx(1.2)
    assert rows['object2', DEFAULT].ratio is None
    assert rows[ALL, DEFAULT].worst == 15.0
    assert rows[ALL, DEFAULT].similar == 0.75
    replanned = {(row.subject, row.kind): row for row in table_rows(made_up(), 'replanned')}
    assert (replanned['object1', TRUE].median, replanned['object1', TRUE].actions) == (1.0, 2.0)
    text = markdown(made_up(), 'the command', 'compiled', complete=False)
    assert '| object1 | fitted | 20 | **2.4** |' in text
    assert 'object2, fitted, pair 1: it failed' in text


def test_every_execution_is_a_row_and_the_picture_is_drawn(tmp_path):
    table = list(csv.DictReader(io.StringIO(executions_csv(made_up()))))
    assert len(table) == 2 * 11
    assert table[1]['errors_percent'] == '20.0 5.0 1.0'
    assert [row['errors_percent'] for row in table if row['failure'] == 'it failed'] == ['', '']
    picture(made_up(), tmp_path / 'x.png')
    assert Image.open(tmp_path / 'x.png').size[0] > 500


def test_journals_keep_every_digit():
    for _, executions in made_up():
        assert PlanOutcome.of(json.loads(json.dumps(asdict(executions)))) == executions
    assert TASK.key != replace(TASK, index=1).key != replace(TASK, options=PlanOptions(draws=1)).key
