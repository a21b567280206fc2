# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The converter: measured data to the messages that a robot would have sent."""

from importlib.util import module_from_spec, spec_from_file_location
import json
from pathlib import Path

import numpy as np
import pytest

from dlo_calibration.files.session import read_session, session_trials

ROOT = Path(__file__).resolve().parents[2]


def load_script():
    spec = spec_from_file_location('convert', ROOT / 'benchmark' / 'convert.py')
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


convert = load_script()


@pytest.fixture
def data(tmp_path):
    """Give a folder of made-up data in the form of the real one."""
    for kind in ('reference', 'mocap', 'hanging'):
        (tmp_path / kind).mkdir()
    along = np.linspace(0, 0.5, 6)
    initial = np.column_stack([along, 0 * along, 0 * along])
    knots = [[{'t': 0.0, 'position': [x, 0, 0]}, {'t': 1.0, 'position': [x, 0.1, 0.1]}] for x in (0.0, 0.5)]
    trials = [
        {'action': 'place_end', 'hands': [{'grip_index': 0, 'knots': knots[0]}], 'release': True},
        {'action': 'two_hands', 'release': False, 'hands': [
            {'grip_index': 5, 'knots': knots[1]}, {'grip_index': 0, 'knots': [*knots[0], {
                't': 2.0, 'position': [0.1, 0.1, 0.1]}]}]}]
    (tmp_path / 'reference' / 'object1.json').write_text(json.dumps({
        'properties': {'mass': 0.03}, 'trials': [
            {**trial, 'initial': initial.tolist(), 'goal': (initial + 0.02).tolist(), 'goal_time': 2.5}
            for trial in trials]}))
    frames = np.arange(20)[:, None, None] / 100
    bent = initial + np.array([0, 0, 1]) * along[:, None] ** 2
    points = bent + np.array([0, 0.3, 0.1]) * frames ** 2 + np.array([0, 0, 0.5]) * along[:, None] * frames
    np.savez(tmp_path / 'mocap' / 'dlo2_train.npz', points=np.stack([points, points + 1]), rate_hz=100.0)
    angle = np.linspace(0, 2 * np.pi, 11)
    loop = np.column_stack([0.1 * np.sin(angle) - 0.02 * angle, 0 * angle, 0.1 * (np.cos(angle) - 1)])
    np.savez(tmp_path / 'hanging' / 'white.npz', points=loop[None], length_m=0.7, mass_per_m=0.02)
    return tmp_path


def trials_of(data, *arguments):
    """Convert, and return the trials of the session with its options."""
    kind, source, *rest = arguments
    assert convert.main(['--data', str(data), kind, source, str(data / 'out'), *rest]) == 0
    session = read_session(data / 'out')
    options = session.options
    trials, refusals = session_trials(session, options)
    assert (session.warnings, refusals) == ((), ())
    return trials, options


def test_reference_actions_keep_their_hands_and_what_they_release(data):
    (place, two), options = trials_of(data, 'reference', 'object1', '--actions', 'place_end,two_hands')
    assert (options.mass, options.table) == (0.03, True)
    assert [hand.grips for hand in two.hands] == [(5,), (0,)]
    assert (place.goals[0].held_by, two.goals[0].held_by) == ((), ('left_hand', 'right_hand'))
    assert [hand.end for hand in two.hands] == [2.0, 2.0]
    np.testing.assert_allclose(two.hands[0].positions, [[0.5, 0, 0], [0.5, 0.1, 0.1], [0.5, 0.1, 0.1]])
    assert place.goals[0].stable and place.goals[0].time == 2.5


def test_unknown_action_is_refused(data, capsys):
    assert convert.main(['--data', str(data), 'reference', 'object1', str(data / 'out')]) == 2
    assert 'drag_quarter' in capsys.readouterr().err


def test_recordings_start_moving_and_all_frames_are_timed(data):
    trials, options = trials_of(data, 'mocap', 'dlo2', '--recordings', '1,0')
    assert not options.table
    with np.load(data / 'mocap' / 'dlo2_train.npz') as source:
        recordings = source['points'][[1, 0]]
    assert len(trials) == 2
    for trial, frames in zip(trials, recordings, strict=True):
        np.testing.assert_allclose(trial.initial.points, frames[1], atol=1e-12)
        np.testing.assert_allclose(trial.velocity, (frames[2] - frames[0]) / 0.02, atol=1e-9)
        assert [round(goal.time * 100) for goal in trial.goals] == list(range(1, 19))
        assert not any(goal.stable for goal in trial.goals)
        assert all(trial.holds(hand, goal) for hand in trial.hands for goal in trial.goals)
        for goal, frame in zip(trial.goals, frames[2:], strict=True):
            np.testing.assert_allclose(goal.chain.points, frame, atol=1e-12)


def test_hands_carry_both_of_their_markers(data):
    (trial,), _ = trials_of(data, 'mocap', 'dlo2')
    with np.load(data / 'mocap' / 'dlo2_train.npz') as source:
        frames = source['points'][0]
    for hand, (outer, inner) in zip(trial.hands, ((0, 1), (5, 4)), strict=True):
        assert set(hand.grips) == {outer, inner}
        positions, turns = hand.poses(np.arange(19) / 100)
        np.testing.assert_allclose(positions, frames[1:, outer], atol=1e-9)
        carried = turns @ (frames[1, inner] - frames[1, outer])
        seen = frames[1:, inner] - frames[1:, outer]
        lengths = np.linalg.norm(carried, axis=1) * np.linalg.norm(seen, axis=1)
        np.testing.assert_allclose(np.sum(carried * seen, axis=1), lengths, atol=1e-9)


def test_goals_can_be_thinned(data):
    (trial,), _ = trials_of(data, 'mocap', 'dlo2', '--every', '6')
    assert [round(goal.time * 100) for goal in trial.goals] == [1, 7, 13]


def test_hanging_wire_is_led_to_its_clamps_and_never_stretched(data):
    (trial,), options = trials_of(data, 'hanging', 'white')
    with np.load(data / 'hanging' / 'white.npz') as source:
        measured = source['points'][0]
    assert not options.table
    assert options.mass == pytest.approx(0.02 * 0.7 * 12 / 10)
    assert trial.initial.length == pytest.approx(0.7 * 12 / 10)
    assert [hand.grips for hand in trial.hands] == [(0, 1), (11, 12)]
    goal, = trial.goals
    assert goal.stable and goal.held_by == ('left_hand', 'right_hand')
    first, last = (hand.poses(np.linspace(0, goal.time, 500)) for hand in trial.hands)
    np.testing.assert_allclose(first[0][-1], measured[0], atol=1e-12)
    np.testing.assert_allclose(last[0][-1], measured[-1], atol=1e-12)
    assert (np.linalg.norm(last[0] - first[0], axis=1) <= 0.7 + 1e-9).all()
    np.testing.assert_allclose(last[1][-1] @ (1, 0, 0), (1, 0, 0), atol=1e-12)
    ends = goal.chain.points[[1, 12]] - goal.chain.points[[0, 11]]
    np.testing.assert_allclose(ends, [[0.07, 0, 0], [0.07, 0, 0]], atol=1e-9)


@pytest.mark.parametrize('arguments', [
    ('hanging', 'red', 'out'), ('mocap', 'dlo2', 'out', '--recordings', '7'),
    ('hanging', 'white', 'out', '--repeats', 'first'), ('mocap', 'dlo2', 'out', '--every', '0')])
def test_missing_recordings_are_refused_in_one_line(data, arguments, capsys, monkeypatch):
    monkeypatch.chdir(data)
    assert convert.main(['--data', str(data), *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (data / 'out').exists()
