# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Markers show the trials in the frame of the session, and what was simulated of them, on both wires."""

from dataclasses import replace
import math

from exported_scene import write_scene
from fitted import fitted
from made_up_dlo import made_up_plan
import numpy as np
import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import toy_trial, ToySimulator
from wire import wire

from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import measured, ParameterSpace
from dlo_calibration.model.pose import Pose
from dlo_calibration.model.trial import Goal
from dlo_calibration.ros.markers import (
    alike,
    error_colour,
    markers,
    MOST_POINTS,
    plan_markers,
    shown_obstacles,
)
from dlo_calibration.search import RandomSearch
from dlo_calibration.simulation.scene import read_scene

STAMP = 12_500_000_000
ADD, DELETE_ALL = 0, 3
LINE_STRIP, LINE_LIST, SPHERE_LIST, TEXT = 4, 5, 7, 9


@pytest.fixture(scope='module')
def result():
    return fitted(toy_trials(2), ParameterSpace(), ToySimulator(), RandomSearch(4, seed=1), budget=5)


def shown(types, trials, result=None):
    """Return markers by namespace, after the wire."""
    array = wire(types)(markers(types, trials, stamp=STAMP, frame_id='table', result=result))
    first, *rest = array.markers
    assert (first.action, first.header.frame_id) == (DELETE_ALL, 'table')
    marks = {}
    for marker in rest:
        marks.setdefault(marker.ns, []).append(marker)
    return marks


def points(marker):
    return np.array([[p.x, p.y, p.z] for p in marker.points])


def test_markers_stay_in_the_frame_of_the_chains(types):
    """A viewer turns and moves the points of a marker by its pose."""
    camera = Pose([0.2, -0.1, 1.5], [0.95, 0.05, 0.02, 0.3])
    trial = toy_trials(1)[0]
    array = wire(types)(markers(types, [trial], stamp=STAMP, frame_id='camera', pose=camera))
    seen = {marker.ns: marker for marker in array.markers}
    line, label = seen['trial_1/initial'], seen['trial_1/label']
    at, turn = line.pose.position, line.pose.orientation
    shown = Pose([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w]).points(points(line))
    assert np.allclose(shown, camera.inverse.points(trial.initial.points))
    at = label.pose.position
    above = camera.points(np.array([at.x, at.y, at.z])) - trial.initial.points[0]
    assert np.allclose(above[:2], 0)
    assert above[2] > 0


def test_collected_trials_show_initial_and_goal_chains_and_hands(types):
    trials = toy_trials(2)
    marks = shown(types, trials)
    assert set(marks) == {f'trial_{k}/{name}' for k in (1, 2)
                          for name in ('initial', 'goal', 'hands', 'label')}
    for k, trial in enumerate(trials, start=1):
        initial, = marks[f'trial_{k}/initial']
        assert np.array_equal(points(initial), trial.initial.points)
        for goal in marks[f'trial_{k}/goal']:
            assert np.array_equal(points(goal), trial.goals[0].chain.points)
        label, = marks[f'trial_{k}/label']
        assert (label.type, label.text) == (TEXT, trial.name)


def test_every_marker_can_be_seen_and_stays(types, result):
    for markers_of_space in shown(types, result.trials, result).values():
        for marker in markers_of_space:
            assert (marker.action, marker.header.frame_id) == (ADD, 'table')
            assert (marker.lifetime.sec, marker.lifetime.nanosec) == (0, 0)
            assert marker.color.a == 1
            assert min(marker.scale.x, marker.scale.y, marker.scale.z) > 0
            assert marker.pose.orientation.w == 1
            assert len(marker.colors) in (0, len(marker.points))
            assert marker.type != LINE_STRIP or len(marker.points) > 1
            assert marker.type != LINE_LIST or len(marker.points) % 2 == 0


def test_result_shows_the_simulated_chain_and_the_error_of_each_point(types, result):
    marks = shown(types, result.trials, result)
    for k, (trial, chains) in enumerate(zip(result.trials, result.chains, strict=True), start=1):
        simulated, = marks[f'trial_{k}/simulated']
        assert np.allclose(points(simulated), chains[0])
        spheres, lines = marks[f'trial_{k}/error']
        assert (spheres.type, lines.type) == (SPHERE_LIST, LINE_LIST)
        errors = np.linalg.norm(chains[0] - trial.goals[0].chain.points, axis=1)
        greens = np.array([colour.g for colour in spheres.colors])
        assert (np.diff(greens[np.argsort(errors)]) <= 1e-6).all()
        ends = points(lines).reshape(-1, 2, 3)
        assert np.allclose(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), errors)
        label, = marks[f'trial_{k}/label']
        assert f'max {measured(errors.max(), "m")}' in label.text


def test_trial_that_came_after_the_result_is_shown_as_measured(types, result):
    trials = [*result.trials, toy_trial(TRUTH, 'trial 3', turn=1.0)]
    marks = shown(types, trials, result)
    assert 'trial_2/simulated' in marks
    assert 'trial_3/goal' in marks
    assert 'trial_3/simulated' not in marks


def test_trial_that_only_has_the_name_of_one_of_the_result_is_shown_as_measured(types, result):
    other = toy_trial(TRUTH, result.trials[0].name, turn=2.0)
    assert 'trial_1/simulated' not in shown(types, [other], result)


def test_a_tracker_that_goes_on_after_the_result_does_not_hide_the_simulation(types, result):
    def streamed(trial, count):
        goals = [replace(goal, chain=Chain(goal.chain.points + 1e-5 * count), count=count)
                 for goal in trial.goals]
        return replace(trial, goals=tuple(goals))

    calibrated = replace(result, trials=tuple(streamed(trial, 40) for trial in result.trials))
    marks = shown(types, [streamed(trial, 50) for trial in toy_trials(2)], calibrated)
    assert 'trial_2/simulated' in marks


def test_only_the_mean_of_a_stream_may_differ_between_trials_that_look_alike():
    trial, other = toy_trials(2)

    def seen(trial, count, move=0.0):
        return replace(trial, goals=tuple(replace(goal, chain=Chain(goal.chain.points + move), count=count)
                                          for goal in trial.goals))

    assert alike([seen(trial, 30), other], [seen(trial, 31, 1e-5), replace(other, name='trial 9')])
    assert not alike([seen(trial, 1)], [seen(trial, 1, 1e-5)])
    assert not alike([trial], [trial, other])
    assert not alike([trial], [replace(trial, initial=Chain(trial.initial.points + 0.1))])


def test_same_thing_has_the_same_id_in_every_message_and_no_two_share_one(types, result):
    before = {(m.ns, m.id): m.type for ms in shown(types, result.trials).values() for m in ms}
    after = [((m.ns, m.id), m.type) for ms in shown(types, result.trials, result).values() for m in ms]
    assert len(dict(after)) == len(after)
    assert before.items() <= dict(after).items()


def test_of_many_goals_a_few_instants_are_shown_the_last_always(types):
    trial, = toy_trials(1)
    goals = [Goal(Chain(trial.initial.points + (0, 0, 0.01 * k)), 0.02 * k, stable=False) for k in range(60)]
    marks = shown(types, [replace(trial, goals=goals)])
    lines = [marker for marker in marks['trial_1/goal'] if marker.type == LINE_STRIP]
    assert len(lines) == 5
    assert any(np.allclose(points(marker), goals[-1].chain.points) for marker in lines)


def test_of_many_points_two_hundred_are_shown_from_the_first_to_the_last(types):
    trial = toy_trial(TRUTH, n=500)
    initial, = shown(types, [trial])['trial_1/initial']
    assert len(initial.points) == MOST_POINTS
    assert np.array_equal(points(initial)[[0, -1]], trial.initial.points[[0, -1]])


def test_markers_are_deleted_when_there_are_no_trials(types):
    assert shown(types, []) == {}


def test_hand_shows_its_path_what_it_grips_and_where_it_opens(types):
    trial, = toy_trials(1)
    hand = trial.hands[0]
    path, grip, end = shown(types, [trial])['trial_1/hands']
    assert np.allclose(points(path)[[0, -1]], hand.positions[[0, -1]])
    assert np.array_equal(points(grip), trial.initial.points[list(hand.grips)])
    position = end.pose.position
    assert np.allclose([position.x, position.y, position.z], hand.positions[-1])


def test_errors_go_from_green_over_yellow_to_red():
    assert error_colour(0.0)[:2] == (0.0, 1.0)
    assert error_colour(0.015)[:2] == (1.0, 1.0)
    for share in (0.03, 1.0, math.inf):
        assert error_colour(share)[:2] == (1.0, 0.0)


def test_points_that_were_not_seen_have_no_spheres(types):
    trial = toy_trials(1)[0]
    hidden = trial.goals[0].chain.points.copy()
    hidden[[2, 5]] = np.nan
    goals = (replace(trial.goals[0], chain=Chain(hidden)),)
    spheres, line = shown(types, [replace(trial, goals=goals)])['trial_1/goal']
    assert np.array_equal(points(spheres), np.delete(trial.goals[0].chain.points, [2, 5], axis=0))
    assert len(line.points) == len(hidden)


def test_hand_that_grips_between_points_is_shown_there(types):
    trial, = toy_trials(1)
    hand = replace(trial.hands[0], grips=(3,), offset=0.25)
    trial = replace(trial, actions=(replace(trial.actions[0], hands=(hand,)),))
    grip = shown(types, [trial])['trial_1/hands'][1]
    expected = trial.initial.points[3] + 0.25 * (trial.initial.points[4] - trial.initial.points[3])
    assert np.allclose(points(grip), expected, atol=2e-3)


def obstacle_marks(types, folder, pose=None):
    """Return the markers of the obstacles of a scene, in the frame of a camera if there is a pose."""
    obstacles = read_scene(write_scene(folder))
    array = wire(types)(markers(types, toy_trials(1), stamp=STAMP, frame_id='table', pose=pose,
                                obstacles=obstacles))
    return obstacles, [marker for marker in array.markers if marker.ns == 'scene/obstacles']


def place(marker):
    """Return the pose of a marker."""
    at, turn = marker.pose.position, marker.pose.orientation
    return Pose([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w])


def test_obstacles_are_shown_as_what_they_are(types, tmp_path):
    obstacles, marks = obstacle_marks(types, tmp_path)
    cube, sphere, cylinder, capsule, *ends, mesh = marks
    assert [marker.type for marker in marks] == [1, 2, 3, 3, 2, 2, 11]
    assert len({marker.id for marker in marks}) == len(marks)
    sizes = [[marker.scale.x, marker.scale.y, marker.scale.z] for marker in marks]
    assert sizes == [pytest.approx(size) for size in (
        [0.2, 0.4, 0.1], [0.1] * 3, [0.02, 0.02, 0.2], [0.04, 0.04, 0.1], [0.04] * 3, [0.04] * 3, [1.0] * 3)]
    for marker, obstacle in zip((cube, sphere, cylinder, capsule), obstacles, strict=False):
        assert place(marker).position == pytest.approx(obstacle.position)
        assert np.abs(place(marker).orientation @ obstacle.turn) == pytest.approx(1)
    assert sorted(end.pose.position.y for end in ends) == pytest.approx([0.45, 0.55])  # it lies along y
    corners = points(mesh)
    assert len(corners) == 12
    assert corners.min(axis=0) == pytest.approx([-0.3, 0, 0])
    assert corners.max(axis=0) == pytest.approx([-0.2, 0.1, 0.2])


def test_obstacles_stand_in_the_frame_of_the_table_wherever_the_camera_is(types, tmp_path):
    camera = Pose([0.2, -0.1, 1.5], [0.95, 0.05, 0.02, 0.3])
    obstacles, marks = obstacle_marks(types, tmp_path, camera)
    edge = np.array([0.1, 0.2, 0.05])  # a corner of the box, in its own frame
    expected = Pose(obstacles[0].position, obstacles[0].turn).points(edge)
    assert camera.points(place(marks[0]).points(edge)) == pytest.approx(expected)
    seen = camera.points(place(marks[-1]).points(points(marks[-1])))
    assert seen.min(axis=0) == pytest.approx([-0.3, 0, 0], abs=1e-6)


def test_a_plan_is_shown_with_its_obstacles(types, tmp_path):
    array = wire(types)(plan_markers(types, made_up_plan(), stamp=STAMP, frame_id='table',
                                     obstacles=shown_obstacles(write_scene(tmp_path))))
    marks = [marker for marker in array.markers if marker.ns == 'scene/obstacles']
    assert [marker.type for marker in marks] == [1, 2, 3, 3, 2, 2, 11]


def test_a_scene_that_cannot_be_read_is_not_shown():
    assert shown_obstacles('nowhere.urdf') == ()
    assert shown_obstacles('') == ()
