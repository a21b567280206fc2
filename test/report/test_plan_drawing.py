# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A plan has a picture of each action, an animation and sentences."""

from dataclasses import replace

from made_up_dlo import made_up_plan, MadeUpDlo, MOVES, straight
import numpy as np
from PIL import Image, ImageColor
import pytest
from toy_simulator import ToySimulator

from dlo_calibration import Chain, InputError
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.report.drawing import View
from dlo_calibration.report.figure import BAND, blank_figure, OBSTACLE, SIMULATED
from dlo_calibration.report.plan_drawing import plan_trial, write_plan_animation, write_plan_picture
from dlo_calibration.report.sentences import plan_sentences
from dlo_calibration.simulation.scene import NO_TRIANGLES, Obstacle


def pixels(plan, path, **keywords):
    write_plan_picture(plan, path, **keywords)
    return np.asarray(Image.open(path).convert('RGB')).astype(int)


def of_colour(image, colour):
    return int((np.abs(image - ImageColor.getrgb(colour)).sum(axis=2) < 12).sum())


def test_a_picture_has_a_panel_for_each_action(tmp_path):
    none, one, two = (pixels(made_up_plan(actions=actions), tmp_path / 'plan.png') for actions in range(3))
    assert two.shape[1] > 1.4 * one.shape[1]
    assert of_colour(none, SIMULATED) == 0 < of_colour(one, SIMULATED) < of_colour(two, SIMULATED)
    assert of_colour(none, BAND) == 0 < min(of_colour(one, BAND), of_colour(two[:, :550], BAND),
                                            of_colour(two[:, 550:], BAND))


def test_a_picture_shows_the_bodies_of_a_scene(tmp_path):
    post = Obstacle('cylinder', np.array([0.1, 0.02]), np.array([0.3, 0.05, 0.05]),
                    np.array([0, 0, 0, 1.0]), 1.0, NO_TRIANGLES)
    bare, shown = (pixels(made_up_plan(actions=1), tmp_path / 'plan.png', obstacles=obstacles)
                   for obstacles in ((), (post,)))
    # The grid has nearly the same grey.
    assert of_colour(shown, OBSTACLE) > of_colour(bare, OBSTACLE) + 500


def test_a_picture_that_cannot_be_written_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match='choose another place'):
        write_plan_picture(made_up_plan(), tmp_path / 'none' / 'plan.png')


def test_the_band_covers_what_its_intervals_sweep_and_nothing_else():
    chain = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [0.2, 0.4, 0.0]])
    lower, upper = chain - [[0.02], [0.05], [0.01]], chain + [[0.02], [0.05], [0.03]]
    axes = blank_figure(4, 4).subplots()
    move = MOVES[0].action(straight())
    View(axes, Trial('t', Chain(chain), (replace(move, hands=(replace(move.hands[0], grips=(0,)),)),),
                     (Goal(Chain(chain), 99.0),)), above=True).draw_band(lower, upper, 'band')
    pieces, = axes.collections
    places = np.random.default_rng(1).uniform((-0.1, -0.1), (0.5, 0.5), (400, 2))
    t = np.linspace(0, 1, 400)[:, None]
    expected = np.zeros(len(places), bool)
    for k in range(2):
        low, high = ((1 - t) * end[k, :2] + t * end[k + 1, :2] for end in (lower, upper))
        expected |= ((low <= places[:, None]) & (places[:, None] <= high)).all(axis=2).any(axis=1)
    # The sign of the radius that makes a path larger depends on its direction.
    shaded = np.any([path.contains_points(places, radius=radius) for path in pieces.get_paths()
                     for radius in (-1e-9, 1e-9)], axis=0)
    assert expected.sum() > 30
    assert (shaded == expected).all()


def test_the_actions_of_a_plan_follow_one_another_in_its_trial():
    trial = plan_trial(made_up_plan())
    first, second = trial.actions
    assert second.start > first.end
    assert all((goal.chain.points == made_up_plan().goal.points).all() for goal in trial.goals)


def test_an_animation_moves_from_the_start(tmp_path, monkeypatch):
    monkeypatch.setattr('dlo_calibration.simulation.motion.FRAME_RATE', 1)
    monkeypatch.setattr('dlo_calibration.report.animation.FRAME_RATE', 1)
    monkeypatch.setattr('dlo_calibration.report.animation.DOTS_PER_INCH', 40)
    write_plan_animation(made_up_plan(goal=straight()), ToySimulator(), Posterior.of(MadeUpDlo()).best,
                         tmp_path / 'plan.gif')
    assert Image.open(tmp_path / 'plan.gif').n_frames > 5


def test_sentences_say_what_each_hand_does_and_how_near_the_dlo_gets():
    first, second, end, _ = plan_sentences(made_up_plan())
    assert first == ('1. grasp_and_place: hand_1 grips at 0.35 of the length, lifts 5 cm, carries it to '
                     '(0.310, 0.120) m and opens; then the points are 56 mm (9.33 %) from the goal on '
                     'average. It bends to a radius of 50 mm at 0.35 of the length, and bears up to 1.5 N at '
                     '1.00 of the length, a strain of 1 %.')
    assert second.startswith('2. drag: hand_2 grips at 0.00 of the length, drags it to (0.000, 0.100) m and '
                             'opens; then the points are 6 mm (1 %) from the goal on average.')
    assert end.startswith('The goal is not reached: with 2 actions, the mean error goes from 106 mm '
                          '(17.7 %) to 7 mm (1.17 %), beyond the tolerance of 6 mm (1 %)')


@pytest.mark.parametrize('changes, words', [
    ({'reached': True, 'error_after': 0.005, 'actions': 1}, 'The goal is reached with 1 action: '),
    ({'reached': True, 'error_before': 0.005, 'actions': 0}, 'The DLO is at the goal already: 5 mm'),
    ({'reached': False, 'error_after': 0.106, 'actions': 0},
     'The goal is not reached, and no action is planned: '),
])
def test_after_the_actions_a_sentence_is_about_the_goal(changes, words):
    assert plan_sentences(made_up_plan(**changes))[changes['actions']].startswith(words)


def test_warnings_are_the_last_sentences():
    assert plan_sentences(made_up_plan(warnings=('the goal is longer',)))[-1] == 'The goal is longer.'


def test_a_missed_goal_is_reported_with_the_reason_why_the_search_ended():
    assert 'The search ended: stopped.' in plan_sentences(made_up_plan(stop_reason='stopped'))[-1]
