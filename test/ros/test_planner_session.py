# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The planner without ROS: what it waits for, refuses, publishes and keeps."""

from dataclasses import replace

from exported_scene import write_scene
import numpy as np
import pytest
from toy_graph import TYPES
from toy_messages import MINUTE, SECOND
from toy_planner import CHAIN, description, PlannerGraph, RESULT, ToyPlan

from dlo_calibration import Chain, InputError
from dlo_calibration.files.result import description_document, read_result
from dlo_calibration.messages.codec import ACTION, chain_cloud, ChainMessage, GOAL, INITIAL, read
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.model.pose import Pose
from dlo_calibration.planning.plan import plain_plan
from dlo_calibration.ros import planner_session
from dlo_calibration.ros.planner_session import PlannerOptions

MOVED = Chain(CHAIN.points + (0.1, 0.0, 0.0))
CAMERA = Pose([0.2, -0.1, 1.5], [0.95, 0.05, 0.02, 0.3])  # in the table's frame


@pytest.fixture
def started(monkeypatch):
    """Give a function that returns a graph with a session, which it ends after the test."""
    graphs = []

    def start(plan=None, **options):
        monkeypatch.setattr(planner_session, 'plan', plan or ToyPlan())
        graphs.append(PlannerGraph(**options))
        return graphs[-1]

    yield start
    for graph in graphs:
        graph.session.close()


def cloud(chain=CHAIN, stamp=MINUTE, frame_id='table'):
    return chain_cloud(TYPES, chain, stamp, frame_id)


def test_status_names_what_it_waits_for(started):
    graph = started()
    for kind, message, missing in (
            ('dlo_description', description(), 'chain goal_chain'),
            ('chain', cloud(), 'goal_chain'), ('goal_chain', cloud(), '')):
        done, answer = graph.session.request('plan')
        assert not done and answer.startswith('~/plan: no ') and kind in answer
        graph.hear(kind, message)
        graph.session.tick()
        assert (graph.status['state'], graph.status['missing']) == ('waiting', missing)
    assert graph.status['detail'] == 'for ~/plan'
    assert graph.planned()['state'] == 'done'


def test_a_plan_is_published_as_steps_action_and_markers(started):
    plan = ToyPlan()
    graph = started(plan, tolerance=2.0, least_bend_radius=0.02, most_tension=5.0)
    graph.send_chains(CHAIN, MOVED)
    status = graph.planned()
    (described, start, goal, options, simulation), = plan.calls
    assert np.array_equal(start.points, CHAIN.points) and np.array_equal(goal.points, MOVED.points)
    assert options == PlannerOptions(tolerance=2.0, least_bend_radius=0.02, most_tension=5.0)
    assert described.values == read_result(RESULT).values
    assert simulation == read_result(RESULT).file_options.options()
    steps, = graph.steps
    assert [action['name'] for action in steps['actions']] == ['grasp_and_place', 'drag']
    assert [(action['least_bend_radius_m'], action['least_bend_radius_at_m'], action['most_tension_n'])
            for action in steps['actions']] == 2 * [(0.05, 0.21, 1.5)]
    assert steps.keys() == plain_plan(plan(*plan.calls[0][:4], simulation=None, on_progress=id,
                                           should_stop=bool)).keys()
    assert (status['actions'], status['reached'], status['plans']) == ('2', 'false', '1')
    assert float(status['error_after_mm']) == 1e3 * steps['error_after_m']
    markers = graph.heard['markers'][-1].markers
    assert {marker.header.frame_id for marker in markers} == {'table'}
    assert {marker.ns for marker in markers[1:]} == {'plan/start', 'plan/goal', 'plan/label', *(
        f'action_{k}/{name}' for k in (1, 2) for name in ('predicted', 'interval', 'hands', 'label'))}


def test_the_obstacles_that_are_planned_with_are_shown(started, tmp_path):
    graph = started(ToyPlan(), simulation=[f'scene={write_scene(tmp_path)}'])
    graph.send_chains(CHAIN, MOVED)
    graph.planned()
    shown = [marker for marker in graph.heard['markers'][-1].markers if marker.ns == 'scene/obstacles']
    assert len(shown) == 7


def test_the_calibrator_reads_the_published_action_as_that_of_the_plan(started):
    plan = ToyPlan()
    graph = started(plan)
    graph.send_chains(CHAIN, MOVED)
    graph.planned()
    message, = graph.heard['action']
    heard = read(ACTION, message)
    hand = graph.steps[0]['actions'][0]['hands'][0]
    assert (heard.stamp, heard.frame_id, heard.names) == (MINUTE, 'table', (hand['name'],))
    np.testing.assert_allclose(np.column_stack([heard.times, heard.positions[:, 0]]), hand['waypoints'],
                               atol=1e-9)
    collector = TrialCollector(read_result(RESULT).file_options.options())
    for content in (ChainMessage(INITIAL, MINUTE - SECOND, 'table', CHAIN), heard,
                ChainMessage(GOAL, 2 * MINUTE, 'table', MOVED)):
        collector.add(content)
    trial, = collector.trials
    collected, = trial.hands
    assert collected.grips == (hand['grip'],)


def test_with_a_frame_pose_chains_and_plans_are_in_the_frame_of_the_camera(started):
    plan, level = ToyPlan(), started()
    level.send_chains(CHAIN, MOVED)
    level.planned()
    graph = started(plan, frame_pose=str(CAMERA))
    graph.send_chains(CAMERA.inverse.chain(CHAIN), CAMERA.inverse.chain(MOVED), frame_id='camera')
    graph.planned()
    (_, start, goal, *_), = plan.calls
    assert np.allclose(start.points, CHAIN.points) and np.allclose(goal.points, MOVED.points)
    for tilted, right in zip(graph.steps[0]['actions'], level.steps[0]['actions'], strict=True):
        for key in ('predicted', 'waypoints'):
            planned, level_values = (np.array(each[key] if key in each else each['hands'][0][key])[:, -3:]
                           for each in (tilted, right))
            assert np.allclose(CAMERA.points(planned), level_values)
        lower, upper = np.array(tilted['predicted_lower_upper_m'])
        assert (lower <= tilted['predicted']).all() and (upper >= tilted['predicted']).all()
        true = np.linalg.norm(np.subtract(*right['predicted_lower_upper_m']), axis=1)
        assert np.allclose(np.linalg.norm(upper - lower, axis=1), true)
    heard, right = (read(ACTION, planner.heard['action'][0]) for planner in (graph, level))
    assert heard.frame_id == 'camera'
    assert np.allclose(CAMERA.points(heard.positions), right.positions)
    line, = (marker for marker in graph.heard['markers'][0].markers if marker.ns == 'plan/start')
    at, turn = line.pose.position, line.pose.orientation
    seen = Pose([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w]).points(
        np.array([[p.x, p.y, p.z] for p in line.points]))
    assert np.allclose(seen, CAMERA.inverse.points(CHAIN.points))


def test_without_a_frame_pose_that_of_the_description_is_used(started):
    plan, text = ToyPlan(), RESULT.read_text(encoding='utf-8')
    graph = started(plan)
    graph.hear('dlo_description', description(text.replace(
        '<options>', f'<options><option name="frame_pose" value="{CAMERA}"/>')))
    for kind in ('chain', 'goal_chain'):
        graph.hear(kind, cloud(CAMERA.inverse.chain(CHAIN)))
    graph.planned()
    assert np.allclose(plan.calls[0][1].points, CHAIN.points)


def test_an_action_has_a_stamp_even_before_a_simulated_clock_runs(started):
    graph = started()
    graph.stamp = lambda: 0
    graph.send_chains()
    graph.planned()
    assert read(ACTION, graph.heard['action'][0]).stamp > 0


@pytest.mark.parametrize('changes, words', [
    ({'actions': 0, 'reached': True, 'error_before': 0.001, 'error_after': 0.001}, 'is at the goal already'),
    ({'actions': 0, 'error_after': 0.106}, 'The goal is not reached')])
def test_a_plan_without_actions_publishes_none(started, changes, words):
    graph = started(ToyPlan(**changes))
    graph.send_chains()
    status = graph.planned()
    assert status['state'] == 'done' and words in status['detail']
    assert graph.steps[0]['actions'] == []
    assert not graph.heard['action']


def test_a_goal_that_is_not_reached_is_a_warning_and_its_warnings_are_logged(started):
    graph = started(ToyPlan(warnings=('The goal is 3 % longer than the DLO.',)))
    graph.send_chains()
    assert graph.planned()['remarks'] == 'The goal is 3 % longer than the DLO.'
    assert graph.heard['status'][-1].status[0].level == 1
    assert graph.logged['warn'] == ['The goal is 3 % longer than the DLO.']


def test_a_stream_of_refusals_changes_the_status_at_most_once_a_second(started):
    graph = started(ToyPlan())
    graph.session.status_period, before = 1.0, len(graph.heard['status'])
    for k in range(20):
        graph.session.refuse(f'chain stamped {k} s: nothing')
        graph.session.tick()
    assert len(graph.heard['status']) - before <= 1
    graph.elapsed += 1.0
    graph.session.tick()
    assert graph.status['last_refusal'].endswith(' (20 times)')


def test_one_plan_at_a_time_and_stop_publishes_the_best_so_far(started):
    plan = ToyPlan(held=True)
    graph = started(plan)
    assert graph.session.request('stop') == (
        False, '~/stop: no plan under way; expected one; call ~/plan first')
    graph.send_chains()
    assert graph.session.request('plan')[0]
    assert graph.status['state'] == 'planning'
    assert 'the first actions' in graph.status['detail']
    graph.until(lambda: graph.status['detail'] == '')
    done, answer = graph.session.request('plan')
    assert not done and 'a plan under way' in answer
    assert not graph.heard['action']
    assert graph.session.request('stop')[0]
    graph.until(lambda: graph.status['state'] == 'done')
    assert len(plan.calls) == len(graph.heard['action']) == len(graph.steps) == 1


def test_progress_is_sent_ten_times_a_second_at_most(started):
    plan = ToyPlan(held=True)
    graph = started(plan)
    graph.send_chains()
    graph.session.request('plan')
    assert plan.reported.wait(60)
    for _ in range(50):
        graph.elapsed += 0.01
        graph.session.tick()
    progress = [{pair.key: pair.value for pair in message.status[0].values}
                for message in graph.heard['progress']]
    assert 1 <= len(progress) <= 6
    assert progress[-1]['rollouts'] == '99'  # the newest, not the oldest that waits


def bad_messages():
    unstamped = cloud()
    unstamped.header.stamp.sec = unstamped.header.stamp.nanosec = 0
    infinite = cloud()
    infinite.data = np.concatenate([np.frombuffer(np.array([np.inf]).tobytes(), np.uint8), infinite.data[8:]])
    result = RESULT.read_text(encoding='utf-8')
    colour = result.replace('"flexibility"', '"colour"')
    return [
        ('chain', infinite, 'chain stamped 60 s: infinity'),
        ('goal_chain', infinite, 'goal_chain stamped 60 s: infinity'),
        ('goal_chain', unstamped, 'goal_chain stamped 0 s: a stamp of zero'),
        ('dlo_description', description('no XML'), 'dlo_description, line 1'),
        ('dlo_description', description(colour), 'dlo_description, line'),
        ('dlo_description', description(f'{result}<!--{"x" * 10**6}-->'), 'expected at most 1000000')]


@pytest.mark.parametrize('kind, message, words', bad_messages())
def test_a_bad_message_is_refused_once_and_the_last_good_one_stays(started, kind, message, words):
    plan = ToyPlan()
    graph = started(plan)
    graph.send_chains(CHAIN, MOVED)
    for _ in range(3):
        graph.hear(kind, message)
    assert words in graph.status['last_refusal']
    warning, = graph.logged['warn']
    assert words in warning and warning.count('\n') == 0
    graph.planned()
    (described, start, goal, *_), = plan.calls
    assert np.array_equal(start.points, CHAIN.points) and np.array_equal(goal.points, MOVED.points)
    assert described.values == read_result(RESULT).values


def test_bytes_that_are_no_message_are_refused(started):
    graph = started()
    graph.send_chains()
    for kind in ('chain', 'goal_chain', 'dlo_description'):
        graph.session.hear(kind, b'\x00\x01\x00\x00\xff\xff')
        assert graph.status['last_refusal'].startswith(f'{kind}: bytes that do not decode')
    assert graph.planned()['state'] == 'done'


def test_chain_and_goal_in_different_frames_are_refused(started):
    graph = started()
    graph.send_chains()
    graph.hear('goal_chain', cloud(frame_id='camera'))
    done, answer = graph.session.request('plan')
    assert not done
    assert "frame_id 'camera'" in answer and "'table'" in answer


def test_of_a_fast_stream_few_chains_are_read_and_the_newest_is_planned_with(started):
    plan = ToyPlan()
    graph = started(plan)
    graph.send_chains()
    before = graph.decoded
    for k in range(300):  # ten seconds
        graph.elapsed += 1 / 30
        graph.hear('chain', cloud(Chain(CHAIN.points + (0.0, 1e-3 * k, 0.0)), MINUTE + k + 1))
        graph.session.tick()
    assert graph.decoded - before <= 70
    graph.planned()
    assert plan.calls[0][1].points[0, 1] == pytest.approx(CHAIN.points[0, 1] + 0.299)


def test_a_later_description_replaces_the_earlier_one(started):
    plan = ToyPlan()
    graph = started(plan)
    graph.send_chains()
    graph.planned()
    other = replace(read_result(RESULT), length=0.61)
    graph.hear('dlo_description', description(description_document(other).decode()))
    graph.planned()
    assert [call[0].length for call in plan.calls] == [read_result(RESULT).length, 0.61]


def test_a_scene_that_a_message_names_is_no_reason_to_plan_without_it(started):
    graph = started()
    graph.send_chains()
    text = RESULT.read_text(encoding='utf-8')
    assert 'name="scene" value=""' in text
    graph.hear('dlo_description', description(text.replace('name="scene" value=""',
                                                           'name="scene" value="/etc/passwd"')))
    done, answer = graph.session.request('plan')
    assert not done
    assert 'scene' in answer and 'parameter description' in answer


def test_the_simulation_is_that_of_the_description_unless_a_parameter_replaces_it(started):
    plan = ToyPlan()
    graph = started(plan, simulation=['nodes=21', 'table=true', 'table_height=-0.001'])
    graph.send_chains()
    graph.planned()
    recorded = read_result(RESULT).file_options.options()
    assert plan.calls[0][-1] == replace(recorded, nodes=21, table_height=-0.001)


@pytest.mark.parametrize('text', ['nodes', 'nodes=many', 'nodes=2', 'seed=3', 'table=yes', '=3'])
def test_a_bad_option_of_the_simulation_is_refused(text):
    with pytest.raises(InputError, match='parameter (simulation|nodes|table): '):
        PlannerOptions(simulation=(text,))


def test_chains_that_do_not_belong_together_are_refused_in_the_answer(started):
    graph = started()
    graph.send_chains(CHAIN, Chain(CHAIN.points * 1000))
    done, answer = graph.session.request('plan')
    assert not done and answer.startswith('goal chain: a length of ')
    assert graph.status['last_refusal'] == answer
    graph.send_chains(CHAIN, Chain(CHAIN.points + (0, 0, 0.5)))
    done, answer = graph.session.request('plan')
    assert not done and 'above the table' in answer


@pytest.mark.parametrize('error, words', [
    (InputError('goal', 'points in the air', 'a goal on the table', 'lower it'), 'goal: points in the'),
    (ZeroDivisionError('a defect'), 'ZeroDivisionError: a defect')])
def test_a_plan_that_fails_says_why_and_the_next_one_works(started, error, words):
    plan = ToyPlan(error=error)
    graph = started(plan)
    graph.send_chains()
    status = graph.planned()
    assert status['state'] == 'failed' and words in status['detail']
    assert graph.heard['status'][-1].status[0].level == 2
    assert words in graph.logged['error'][0]
    assert not graph.heard['action'] and not graph.steps
    plan.error = None
    assert graph.planned()['state'] == 'done'


def test_closing_while_it_plans_publishes_nothing_more(started):
    graph = started(ToyPlan(held=True))
    graph.send_chains()
    graph.session.request('plan')
    graph.session.close()
    assert not graph.heard['action'] and not graph.steps
