# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A trial in a wrong frame, unit or order of points gives a warning with a remedy; a good one gives none."""

from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
import os
from pathlib import Path

import numpy as np
import pytest
from rods_at_rest import trial_of
from trial_contents import anew

from dlo_calibration.calibration.options import Options
from dlo_calibration.files.request import read_request, request_trials
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import ActionMessage
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import trial_messages
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.pose import Pose
from dlo_calibration.model.trial import Goal
from dlo_calibration.observation import implausible, implausible_trials
from dlo_calibration.observation.plausibility import observation_warnings, repeated_trials, reversed_trials

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / 'msg_samples'
DATA = Path(os.environ.get('DLO_DATA', ROOT / '../shared/data'))
LEVEL = (0.0, 0.0, 0.0, 1.0)
QUARTER = np.sqrt(0.5)


@pytest.fixture(scope='module')
def lying():
    """Give the trials of the first sample, whose DLO lies on a table at 0 m."""
    return read_session(SAMPLES / 'object1').trials


def moved(trial, position=(0.0, 0.0, 0.0), orientation=LEVEL, scale=1.0):
    """Return a trial as seen from a frame with another pose or unit."""
    trial = Pose(position, orientation).trial(trial)

    def chain(original):
        return replace(original, points=scale * original.points)

    hands = [tuple(Hand(hand.name, hand.grips, hand.times, scale * hand.positions, hand.orientations)
                   for hand in action.hands) for action in trial.actions]
    return replace(trial, initial=chain(trial.initial), actions=tuple(map(Action, hands)),
                   goals=tuple(replace(goal, chain=chain(goal.chain)) for goal in trial.goals))


def turned(chain):
    return replace(chain, points=chain.points[::-1])


@pytest.mark.parametrize('name', [f'object{k}' for k in range(1, 6)])
def test_nothing_is_wrong_with_a_sample_session(name):
    session = read_session(SAMPLES / name)
    assert len(session.trials) == 4
    assert implausible_trials(session.trials, 0.0) == ()


@pytest.mark.parametrize('name', ['push_and_release', 'hand_paths', 'named_actions'])
def test_nothing_is_wrong_with_a_sample_request(name):
    request = read_request(SAMPLES / 'xml' / f'{name}.xml')
    trials, _ = request_trials(request, request.file_options.options())
    assert trials
    assert implausible_trials(trials, 0.0) == ()


@pytest.mark.parametrize(('change', 'words'), [
    ({'position': (0, 0, 0.75)}, ('754 mm above the table', 'table_height to about 0.754', 'frame_pose')),
    ({'position': (0, 0, 0.06)}, ('64.4 mm above the table', 'table_height to about 0.0644')),
    ({'position': (0, 0, -0.75)}, ('746 mm below the table', 'table_height to about -0.746')),
    ({'orientation': (-QUARTER, 0, 0, QUARTER)}, ('90 degrees from level', 'z is up', 'frame_pose')),
    ({'orientation': (0, QUARTER, 0, QUARTER)}, ('90 degrees from level', 'frame_pose')),
    ({'position': (0, 0, 0.8), 'orientation': (0.97, 0, 0, 0.26)}, ('degrees from level', 'frame_pose')),
    ({'scale': 1000.0}, ('601.5 m long', 'millimetres (0.601 m then)')),
    ({'scale': 1 / 0.0254}, ('23.', 'inches (0.601 m then)')),
], ids=['above', 'near above', 'below', 'y up', 'x up', 'camera', 'millimetres', 'inches'])
def test_a_warning_about_a_wrong_frame_or_unit_names_the_remedy(lying, change, words):
    text, = implausible(moved(lying[0], **change), 0.0)
    assert text.startswith('trial 1: a DLO ')
    for word in words:
        assert word in text


def test_a_level_dlo_in_the_air_with_a_hand_at_its_end_lies_where_no_table_is(lying):
    first = moved(lying[0], (0, 0, 0.75))
    timed = replace(first, goals=(replace(first.goals[0], stable=False),))
    text, = implausible(timed, 0.0)
    assert 'begins at rest 754 mm above the table' in text


def test_the_same_frame_is_right_where_the_table_is_said_to_be_there(lying):
    assert implausible_trials([moved(trial, (3.0, -2.0, 0.75)) for trial in lying], 0.75) == ()


def test_a_dlo_that_nothing_holds_needs_a_table_or_an_obstacle(lying):
    text, = implausible(lying[0], None)
    assert 'nothing holds' in text
    assert 'set table to true and table_height to 0.00' in text
    assert implausible(moved(lying[0], (0, 0, 0.75)), 0.0, scene=True) == ()


def test_there_is_a_warning_about_points_that_run_from_the_other_end(lying):
    first, second = lying[:2]
    swapped = replace(first, goals=(replace(first.goals[0], chain=turned(first.goals[0].chain)),))
    text, = implausible(swapped, 0.0)
    assert 'a goal chain at 2.25 s whose points run from the other end' in text
    again = replace(second, initial=first.goals[-1].chain)
    assert implausible(again, 0.0, before=first) == ()
    text, = implausible(replace(second, initial=turned(first.goals[-1].chain)), 0.0, before=first)
    assert 'the last one of trial 1 from the other end' in text


def whole(trial):
    """Return a trial whose chains all run from the other end."""
    return replace(trial, initial=turned(trial.initial),
                   goals=tuple(replace(goal, chain=turned(goal.chain)) for goal in trial.goals))


@pytest.mark.parametrize('which', ['initial', 'trial'])
def test_a_reversed_trial_does_not_make_the_next_ones_reversed(lying, which):
    session = [replace(trial, initial=before.goals[-1].chain)
               for before, trial in zip(lying, lying[1:], strict=False)]
    right = session[1]
    session[1] = {'initial': replace(right, initial=turned(right.initial)), 'trial': whole(right)}[which]
    texts = implausible_trials([lying[0], *session], 0.0)
    assert {text.partition(':')[0] for text in texts} == {right.name}
    assert len(texts) == 1 and 'from the other end' in texts[0] or 'the other end of the DLO' in texts[0]
    assert reversed_trials([lying[0], *session]) == (False, False, True, False)


def test_the_first_goal_of_a_stream_is_compared_with_the_initial_chain(lying):
    first = lying[0]
    soon = Goal(turned(first.initial), 0.1, stable=False)
    text, = implausible(replace(first, goals=(soon, replace(first.goals[0], chain=turned(
        first.goals[0].chain)))), 0.0)
    assert 'a goal chain at 0.1 s whose points run from the other end' in text
    assert implausible(replace(first, goals=(replace(soon, chain=first.initial), *first.goals)), 0.0) == ()


def test_a_trial_that_repeats_another_bit_for_bit_is_named(lying):
    again = replace(lying[0], name='trial 5')
    assert repeated_trials(lying) == ()
    text, = repeated_trials([*lying, again])
    assert text.startswith('trial 5: the initial chain, hands and goal chains of trial 1, bit for bit')
    goal = lying[0].goals[0]
    other = replace(again, goals=(replace(goal, chain=replace(goal.chain, points=goal.chain.points + 1e-9)),))
    assert repeated_trials([*lying, other]) == ()


def hanging(away):
    """Return a trial whose DLO hangs on one pin, away from the vertical by an angle [rad]."""
    along = np.linspace(0.0, 0.5, 11)[:, None]
    points = along * [np.sin(away), 0.0, -np.cos(away)] + [0.0, 0.0, 0.8]
    return trial_of(points, [(0,)], initial=points)


def test_a_dlo_on_a_pin_hangs_straight_below_it():
    assert implausible(hanging(0.3), 0.0) == ()
    assert implausible(hanging(0.3), None) == ()
    text, = implausible(hanging(np.pi / 2), None)
    assert '90 degrees from straight below the hands' in text
    text, = implausible(hanging(np.pi), None)
    assert '180 degrees' in text


def test_the_collector_warns_once_when_a_trial_is_complete(lying):
    collector = TrialCollector(Options())
    warnings = []
    for message in trial_messages(tuple(moved(trial, (0, 0, 0.75)) for trial in lying[:2]), 'camera'):
        collector.add(message)
        warnings += [(type(message) is ActionMessage, text) for text in collector.take_warnings()]
    assert [text.split(':')[0] for _, text in warnings] == ['trial 1', 'trial 2']
    assert collector.take_warnings() == ()
    assert collector.count == 2
    right = anew(collector, Options(table_height=0.75))
    assert right.take_warnings() == ()


@pytest.mark.parametrize('source', [('reference', 'object2'), ('mocap', 'dlo3', '--recordings', '0'),
                                    ('hanging', 'white', '--repeats', '0')], ids=lambda source: source[0])
def test_nothing_is_wrong_with_measured_sessions(tmp_path, source):
    if not DATA.is_dir():
        pytest.skip(f'{DATA} is not there; DLO_DATA names the folder of measured data')
    place = spec_from_file_location('convert', ROOT / 'benchmark' / 'convert.py')
    convert = module_from_spec(place)
    place.loader.exec_module(convert)
    kind, name, *rest = source
    assert convert.main(['--data', str(DATA), kind, name, str(tmp_path / 'out'), *rest]) == 0
    session = read_session(tmp_path / 'out')
    assert session.trials
    assert implausible_trials(session.trials, 0.0 if session.options.table else None) == ()


def noisy(trials, sigma):
    generator = np.random.default_rng(0)

    def chain(exact):
        return replace(exact, points=exact.points + generator.normal(0, sigma, exact.points.shape))

    return [replace(trial, initial=chain(trial.initial),
                    goals=tuple(replace(goal, chain=chain(goal.chain)) for goal in trial.goals))
            for trial in trials]


def test_nothing_is_wrong_with_the_observation_of_a_sample(lying):
    assert observation_warnings(lying, 0.0, 0.03) == ()


@pytest.mark.parametrize(('length', 'words'), [
    (0.1, 'a time step of 3 ms for a DLO of 100 mm; expected at most 2.5 ms'),
    (0.01, 'set time_step to 3e-4'), (0.3, '')])
def test_a_step_that_is_too_long_for_a_short_dlo_is_named(length, words):
    trial = trial_of(np.linspace([0, 0, 0.2], [length, 0, 0.2], 11), [(0,)], length=length)
    warnings = observation_warnings([trial], None, 0.0, 3e-3)
    assert any(words in warning for warning in warnings) if words else not warnings


def test_the_noise_of_chains_is_named(lying):
    words, = observation_warnings(noisy(lying, 0.007), 0.0, 0.03)
    assert words.startswith('the chains: a noise of 7')


@pytest.mark.parametrize(('height', 'words'), [(0.01, 'below its top'), (-0.02, 'lighter than foam')])
def test_a_table_at_a_wrong_height_is_named(lying, height, words):
    warning, = observation_warnings(lying, height, 0.03)
    assert words in warning
    assert 'table_height' in warning


def test_a_dlo_of_unknown_mass_may_be_as_thick_as_it_lies_high(lying):
    assert observation_warnings(lying, -0.02) == ()
