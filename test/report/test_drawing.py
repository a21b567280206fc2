# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures are drawn for whatever trials there are, and show what differs."""

from dataclasses import replace
import io
from pathlib import Path
import tempfile

import numpy as np
from PIL import Image, ImageColor
import pytest
from toy_messages import toy_trials

from dlo_calibration import Action, Chain, Goal, Hand, InputError
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import shown_goals, Trial
from dlo_calibration.report.animation import write_animation
from dlo_calibration.report.drawing import Drawn, hand_colours, session_picture, trial_panels, View
from dlo_calibration.report.figure import blank_figure, SIMULATED
from dlo_calibration.simulation import core
from dlo_calibration.simulation.motion import densely, MOST_FRAMES, simulated_motion
from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import Rollout
from dlo_calibration.simulation.script import Script, Settling


def chains_of(trial, shift=0.0):
    return np.stack([goal.chain.points + (0, 0, shift) for goal in trial.goals])


def tracked(count):
    """Return a trial that was observed at many instants."""
    trial, = toy_trials(1)
    goals = [Goal(Chain(trial.initial.points + (0, 0, 0.01 * k)), 0.05 * k, stable=False)
             for k in range(count)]
    return replace(trial, goals=goals)


def trial_png(trial, chains):
    """Return the picture as the bytes of a PNG."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'trial.png'
        session_picture([trial], None if chains is None else [chains], path)
        return path.read_bytes()


def pixels(trial, chains):
    return np.asarray(Image.open(io.BytesIO(trial_png(trial, chains))).convert('RGB')).astype(int)


def simulated(image):
    """Count pixels of the colour of what is simulated."""
    return int((np.abs(image - ImageColor.getrgb(SIMULATED)).sum(axis=2) < 30).sum())


@pytest.mark.long
def test_simulated_chain_is_drawn_where_there_is_one():
    trial, = toy_trials(1)
    assert simulated(pixels(trial, None)) == 0
    assert simulated(pixels(trial, chains_of(trial, 0.05))) > 500


@pytest.mark.long
def test_picture_of_a_session_has_a_row_per_trial(tmp_path):
    trials = toy_trials(2)
    session_picture(trials[:1], [chains_of(trials[0])], tmp_path / 'one.png')
    session_picture(trials, [chains_of(trial) for trial in trials], tmp_path / 'both.png')
    alone, both = Image.open(tmp_path / 'one.png'), Image.open(tmp_path / 'both.png')
    assert alone.width == both.width
    assert 1.7 * alone.height < both.height < 2.05 * alone.height


@pytest.mark.long
def test_picture_does_not_depend_on_what_was_drawn_before():
    first, second = toy_trials(2)
    once = trial_png(first, chains_of(first))
    trial_png(second, None)
    assert trial_png(first, chains_of(first)) == once


@pytest.mark.long
@pytest.mark.parametrize('trial', [
    tracked(40),
    Trial('straight up', Chain([[0, 0, 0], [0, 0, 1], [0, 0, 2.0]]),
          (Action((Hand('h', (0,), [0.0], [[0, 0, 0]]),)),),
          (Goal(Chain([[0, 0, 0], [0, 0, 1], [0, 0, 2.0]]), 1.0),)),
    Trial('eight hands $_{$', Chain(np.eye(3)[[0] * 9] * np.arange(1, 10)[:, None]),
          (Action(tuple(Hand(f'_$^$_{k}', (k, k + 1), [0.0, 1.0], np.eye(3)[:2] * k) for k in range(8))),),
          (Goal(Chain(np.eye(3)[[1] * 9] * np.arange(1, 10)[:, None]), 2.0),)),
], ids=lambda trial: trial.name)
def test_picture_of_unusual_trials(trial):
    assert pixels(trial, chains_of(trial, 0.01)).std() > 10


def test_file_that_cannot_be_written_is_an_input_error(tmp_path):
    trial, = toy_trials(1)
    with pytest.raises(InputError, match='choose another place'):
        session_picture([trial], None, tmp_path / 'none' / 'one.png')


def test_side_view_looks_across_the_trial():
    trial, = toy_trials(1)
    axes = blank_figure(4, 4).subplots()
    across, up = View(axes, trial, above=False).flat(np.eye(3))
    assert up.tolist() == [0, 0, 1]
    assert np.linalg.norm(across) == pytest.approx(1)
    assert abs(across[0]) > 0.9


@pytest.mark.parametrize('count', [1, 2, 5, 6, 500])
def test_few_goals_are_shown_the_last_always(count):
    chosen = shown_goals(count)
    assert chosen[-1] == count - 1
    assert len(chosen) == min(count, 5)
    assert chosen == sorted(set(chosen))


def stream(rest=100, moving=100):
    """Return a trial of a stream of goals, first in motion and then at rest, and chains that are off once."""
    trial = tracked(1)
    chain = trial.goals[0].chain
    goals = [Goal(Chain(chain.points + (0, 0, 0.01 * max(moving - k, 0))), 5 + 0.03 * k, stable=k >= moving)
             for k in range(moving + rest)]
    trial = replace(trial, goals=tuple(goals))
    off = np.exp(-0.5 * ((np.arange(moving + rest) - 40) / 5) ** 2)
    return trial, chains_of(trial) + 0.1 * off[:, None, None]


def test_of_a_stream_the_largest_error_is_drawn_and_a_rest_only_once():
    trial, chains = stream()
    shown = [goal for goal, _ in Drawn(trial, chains, {}).goals()]
    assert 40 in shown  # the largest error
    assert shown[-1] == len(trial.goals) - 1
    assert len(shown) == 5
    assert sum(trial.goals[k].stable for k in shown) == 1
    times = [trial.goals[k].time for k in shown]
    assert np.diff(times).min() > 0.5  # not five times the same instant


def test_few_goals_are_all_drawn_unless_they_are_the_same_rest():
    trial, _ = stream(rest=1, moving=4)
    assert [goal for goal, _ in Drawn(trial, chains_of(trial, 0.01), {}).goals()] == [0, 1, 2, 3, 4]
    trial, _ = stream(rest=4, moving=0)
    assert [goal for goal, _ in Drawn(trial, chains_of(trial, 0.01), {}).goals()] == [3]


@pytest.mark.parametrize('shift, scale', [(0.0, 1.0), (1000.0, 1.0), (0.0, 0.03)])
def test_labels_stand_beside_numbers_and_in_the_picture(shift, scale, monkeypatch):
    trial = tracked(3)
    trial = replace(
        trial, initial=Chain(trial.initial.points * scale + shift), actions=tuple(replace(action, hands=tuple(
            replace(hand, positions=hand.positions * scale + shift) for hand in action.hands))
            for action in trial.actions),
        goals=tuple(replace(goal, chain=Chain(goal.chain.points * scale + shift)) for goal in trial.goals))
    figures = []
    monkeypatch.setattr('matplotlib.figure.Figure.savefig', lambda figure, *_, **__: figures.append(figure))
    trial_panels(Drawn(trial, chains_of(trial, 1e-5), hand_colours([trial])))
    assert len(figures) == 4
    for figure in figures:
        figure.draw_without_rendering()
        axes, whole = figure.axes[0], figure.bbox
        boxes = [axes.title.get_window_extent()]
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            assert axis.get_offset_text().get_text() == ''
            numbers = zip(axis.get_ticklabels(), axis.get_ticklocs(), strict=True)
            boxes += [axis.label.get_window_extent(), *(
                label.get_window_extent() for label, place in numbers if min(limits) <= place <= max(limits))]
        for k, box in enumerate(boxes):
            assert min(box.x0, box.y0, whole.x1 - box.x1, whole.y1 - box.y1) > -1
            assert not any(box.overlaps(other) for other in boxes[:k])


class Following:
    """A simulator whose points go with time: at an instant t, the chain is t higher; at rest, 9 higher."""

    name = 'following'

    def simulate(self, trial, physical):
        chains = [trial.initial.points + (0, 0, 9.0 if goal.stable else goal.time) for goal in trial.goals]
        return Rollout(np.stack(chains), (True,) * len(chains), 1.0, 100)

    def close(self):
        """Hold nothing."""


def test_motion_has_the_simulated_chains_over_time_and_those_at_the_goals():
    trial, = toy_trials(1)
    motion = simulated_motion(trial, Following(), {})
    assert (np.diff(motion.times) > 0).all()
    assert motion.times[0] == 0
    assert motion.times[-1] >= trial.hands[0].end
    heights = (motion.chains - trial.initial.points)[:, :, 2]
    assert np.allclose(heights, motion.times[:, None])
    assert np.allclose(motion.ends[:, :, 2] - trial.initial.points[:, 2], 9.0)


def test_motion_of_a_trial_with_a_hundred_goals_a_second_has_ten_frames_a_second():
    trial, = toy_trials(1)
    goals = [replace(trial.goals[0], time=k / 100, stable=False) for k in range(1, 401)]
    motion = simulated_motion(replace(trial, goals=tuple(goals)), Following(), {})
    assert np.allclose(motion.times, np.arange(41) / 10)
    assert len(motion.ends) == 400


@pytest.mark.parametrize('held_by', [(), ('left_hand',)])
def test_instants_between_change_nothing_of_the_course(held_by):
    def followed(trial):
        """Return the nodes at the goals, and after each step which of them are held, and where all are."""
        layout, course = NodeLayout.of(trial, 11), []
        rope = core.Rope(layout.start(None), ParameterSpace().physical({}, 1.0), 0.01, 0.0, np.zeros(3))

        def step():
            rope.points[rope.held] = rope.targets
            course.append((rope.held, rope.points.copy()))

        nodes, *_ = rope.follow(Script.of(trial, layout, 0.01, Settling()).events, step)
        return layout.observe @ nodes, course

    trial, = toy_trials(1)
    trial = replace(trial, goals=(replace(trial.goals[0], held_by=held_by),))
    (plain, before), (dense, after) = followed(trial), followed(densely(trial))
    assert np.allclose(plain[-1], dense[[goal.stable for goal in densely(trial).goals].index(True)])
    assert bool(before[-1][0]) == bool(after[-1][0]) == bool(held_by)


def test_long_trial_has_no_more_frames_than_a_viewer_can_bear():
    trial, = toy_trials(1)
    late = replace(trial, goals=(replace(trial.goals[0], time=3600.0),))
    assert len(densely(late).goals) <= MOST_FRAMES + 1


def test_animation_moves_and_rests_at_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr('dlo_calibration.simulation.motion.FRAME_RATE', 3)
    monkeypatch.setattr('dlo_calibration.report.animation.FRAME_RATE', 3)
    monkeypatch.setattr('dlo_calibration.report.animation.DOTS_PER_INCH', 40)
    trial, = toy_trials(1)
    write_animation(trial, simulated_motion(trial, Following(), {}), tmp_path / 'one.gif')
    gif = Image.open(tmp_path / 'one.gif')
    frames, durations = [], []
    for k in range(gif.n_frames):
        gif.seek(k)
        frames.append(np.asarray(gif.convert('RGB')).astype(int))
        durations.append(gif.info['duration'])
    assert len(frames) > 6
    assert all((frame != following).any() for frame, following in zip(frames[:-1], frames[1:], strict=True))
    assert durations[-1] > 4 * durations[0]
    assert sum(durations) / 1e3 > trial.hands[0].end


def test_animation_that_cannot_be_written_is_an_input_error(tmp_path):
    trial = tracked(3)
    with pytest.raises(InputError, match='choose another place'):
        write_animation(trial, simulated_motion(trial, Following(), {}), tmp_path / 'none' / 'one.gif')
