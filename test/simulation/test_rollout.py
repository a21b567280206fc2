# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Scripts on an engine that is easy to predict: free nodes sink, held nodes follow."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing

from dlo_calibration import Action, Chain, Goal, Hand, SimulationError, Trial
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation import core
from dlo_calibration.simulation.compiled import Engine
from dlo_calibration.simulation.script import Settling

STEP = 0.01
POINTS = np.stack([np.linspace(0, 1, 11), np.zeros(11), np.zeros(11)], axis=1)
CHAIN = Chain(POINTS)
SPEED = 0.1  # m/s at which free nodes sink
QUARTER = [[0, 0, 0, 1], [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]]  # a turn about z


class Sinking(Engine):
    """Free nodes sink at constant speed until that many seconds were simulated."""

    name = 'sinking'

    def __init__(self, until, **settings):
        super().__init__(table=False, time_step=STEP, **settings)
        self._left = round(until / STEP) if np.isfinite(until) else np.inf

    def simulate(self, trial, physical):
        prepared, start, _ = self._prepare(trial, physical)
        rope = core.Rope(start, physical, STEP, 0.0, np.zeros(3))

        def step():
            assert len(set(rope.held)) == len(rope.held)
            assert rope.targets.shape == (len(rope.held), 3)
            if self._left > 0:
                free = np.setdiff1d(np.arange(len(rope.points)), rope.held)
                rope.points[free, 2] -= SPEED * STEP
            self._left -= 1
            rope.points[rope.held] = rope.targets

        return self._rollout(prepared, rope.follow(prepared.script.events, step))


def rolled(hands, goals, until=np.inf, settling=None, nodes=11):
    actions = [Action(hand if isinstance(hand, tuple) else (hand,)) for hand in hands]
    settling = settling or Settling()
    sinking = Sinking(until, nodes=nodes, stable_distance=settling.distance, stable_time=settling.time,
                      settle_limit=settling.limit)
    return sinking.simulate(Trial('t', CHAIN, actions, goals), ParameterSpace().physical({}, 1.0))


def timed(time, held_by=()):
    return Goal(CHAIN, time, stable=False, held_by=held_by)


def resting(time, held_by=()):
    return Goal(CHAIN, time, held_by=held_by)


def hand(grip, start, end, move=(0, 0, 0), name='left', at=None, turns=None):
    grips = grip if isinstance(grip, tuple) else (grip,)
    begin = POINTS[grips[0]] if at is None else np.asarray(at, float)
    return Hand(name, grips, [start, end], [begin, begin + move], turns)


def test_a_hand_holds_from_its_first_waypoint_to_its_last():
    goals = [timed(t) for t in (0.3, 0.5, 1.0, 1.5, 1.75, 2.0)]
    lifting = hand(4, 0.5, 1.5, (0, 0.2, 0))
    # An action of another hand goes on, so that the goals after the first hand's end are timed ones too.
    chains = rolled([lifting, hand(0, 0.0, 3.0, name='right')], goals).chains
    # It sinks until the hand closes, follows, and sinks again.
    assert chains[:, 4, 2] == pytest.approx(-SPEED * np.array([0.3, 0.5, 0.5, 0.5, 0.75, 1.0]), abs=1e-9)
    assert chains[:, 4, 1] == pytest.approx([0, 0, 0.1, 0.2, 0.2, 0.2], abs=1e-9)
    # A free node sinks all the time, the node of the other hand does not move.
    assert chains[:, 8, 2] == pytest.approx(-SPEED * np.array([0.3, 0.5, 1.0, 1.5, 1.75, 2.0]), abs=1e-9)
    assert chains[:, 0] == pytest.approx(np.zeros((6, 3)), abs=1e-9)


@drawing(25)
@given(st.lists(st.integers(0, 20000), min_size=1, max_size=8, unique=True))
def test_timed_goals_are_seen_at_their_instant_between_steps(instants):
    times = sorted(instant * 1e-4 for instant in instants)
    times = [t for k, t in enumerate(times) if k == 0 or t - times[k - 1] >= 2 * STEP]
    chains = rolled([hand(0, 0.0, 2.0, (0, 0.4, 0))], [timed(t) for t in times]).chains
    assert chains[:, 5, 2] == pytest.approx(-SPEED * np.array(times), abs=1e-9)
    assert chains[:, 0, 1] == pytest.approx(0.2 * np.array(times), abs=1e-9)


def test_goals_closer_than_a_step_are_each_seen_at_their_instant():
    times = [0.1012, 0.1031, 0.1078, 0.1104]
    chains = rolled([hand(0, 0.0, 2.0)], [timed(t) for t in times]).chains
    assert chains[:, 5, 2] == pytest.approx(-SPEED * np.array(times), abs=1e-9)


def test_a_hand_beside_the_point_keeps_its_distance():
    beside = hand(4, 0.0, 1.0, (0, 0.2, 0.1), at=POINTS[4] + (0.005, 0, 0.01))
    chain = rolled([beside], [resting(2.0, held_by=('left',))], until=0.0).chains[0]
    assert chain[4] == pytest.approx(POINTS[4] + (0, 0.2, 0.1), abs=1e-9)


def test_a_pin_does_not_move_as_the_hand_turns_about_it():
    turning = hand(4, 0.0, 1.0, turns=QUARTER)
    chain = rolled([turning], [resting(2.0, held_by=('left',))], until=0.0).chains[0]
    assert chain[4] == pytest.approx(POINTS[4], abs=1e-9)


def test_a_clamp_turns_as_one_rigid_piece_about_the_hand():
    middle = (POINTS[4] + POINTS[5]) / 2
    turning = hand((4, 5), 0.0, 1.0, (0, 0, 0.3), at=middle, turns=QUARTER)
    goals = [timed(0.5), resting(2.0, held_by=('left',))]
    chains = rolled([turning], goals, until=0.0).chains
    eighth = 0.05 * np.sqrt(0.5)
    assert chains[0][[4, 5]] == pytest.approx(
        middle + [(-eighth, -eighth, 0.15), (eighth, eighth, 0.15)], abs=1e-9)
    assert chains[1][[4, 5]] == pytest.approx(middle + [(0, -0.05, 0.3), (0, 0.05, 0.3)], abs=1e-9)


def test_the_turn_of_a_hand_that_was_turned_before_counts_from_there():
    turns = [QUARTER[1], [0, 0, 1, 0]]  # from a quarter to a half
    turning = hand((4, 5), 0.0, 1.0, turns=turns)
    chain = rolled([turning], [resting(2.0, held_by=('left',))], until=0.0).chains[0]
    assert chain[5] == pytest.approx(POINTS[4] + (0, 0.1, 0), abs=1e-9)


@pytest.mark.parametrize('goal', [resting(3.0), resting(500.0)])
def test_a_stable_goal_waits_until_all_is_at_rest(goal):
    rollout = rolled([hand(0, 0.0, 1.0)], [goal], until=2.5)
    assert rollout.settled == (True,)
    assert rollout.chains[0, 5, 2] == pytest.approx(-SPEED * 2.5, abs=1e-9)
    assert rollout.duration == pytest.approx(rollout.steps * STEP)


def test_a_stream_of_stable_goals_waits_once():
    single = rolled([hand(2, 0.0, 1.0)], [resting(1.5)], until=3.0)
    many = rolled([hand(2, 0.0, 1.0)], [resting(1.5 + k / 30) for k in range(20)], until=3.0)
    assert many.steps == single.steps
    assert all(many.settled)
    for chain in many.chains:
        assert chain == pytest.approx(single.chains[0], abs=0)


def test_time_at_rest_is_skipped():
    late = hand(4, 300.0, 301.0, (0, 0.2, 0))
    rollout = rolled([late], [resting(900.0)], until=1.0)
    assert rollout.settled == (True,)
    assert 2.0 < rollout.duration < 4.0
    assert rollout.chains[0, 5, 2] == pytest.approx(-SPEED, abs=1e-9)
    assert rollout.chains[0, 4, 1] == pytest.approx(0.2, abs=1e-9)


def test_no_time_is_skipped_before_a_timed_goal():
    patient = Settling(limit=100.0)
    rollout = rolled([hand(4, 30.0, 31.0)], [timed(5.0), timed(30.5)], until=20.0, settling=patient)
    assert rollout.chains[:, 5, 2] == pytest.approx([-SPEED * 5, -SPEED * 20], abs=1e-9)
    moving = rolled([hand(4, 30.0, 31.0)], [timed(30.5)], settling=patient)
    assert moving.chains[0, 5, 2] == pytest.approx(-SPEED * 30.5, abs=1e-9)
    impatient = rolled([hand(0, 0.0, 1.0)], [timed(15.0)], settling=Settling(limit=2.0))
    assert impatient.chains[0, 5, 2] == pytest.approx(-SPEED * 15, abs=1e-9)
    resting_until = rolled([hand(0, 0.0, 1.0)], [timed(5.0), timed(8.0)], until=6.0)
    assert resting_until.chains[:, 5, 2] == pytest.approx([-SPEED * 5, -SPEED * 6], abs=1e-9)


def test_a_dlo_that_never_settles_is_reported_after_the_limit():
    rollout = rolled([hand(0, 0.0, 1.0)], [resting(1.5)], settling=Settling(0.001, 0.25, 3.0))
    assert rollout.settled == (False,)
    assert rollout.duration == pytest.approx(1.5 + 3.0, abs=2 * STEP)
    assert np.isfinite(rollout.chains).all()


@pytest.mark.parametrize(('distance', 'stable'), [(0.02, False), (0.03, True)])
def test_stable_means_moved_less_than_a_distance_within_a_time(distance, stable):
    # It sinks 2.5 cm in 0.25 s.
    rollout = rolled([hand(0, 0.0, 1.0)], [resting(1.5)], settling=Settling(distance, 0.25, 2.0))
    assert rollout.settled == (stable,)


def test_only_the_goals_that_did_not_settle_are_named():
    hands = [hand(0, 0.0, 1.0), hand(0, 20.0, 21.0)]
    rollout = rolled(hands, [resting(1.5), timed(20.5), resting(22.0)], until=12.0,
                     settling=Settling(0.001, 0.25, 3.0))
    assert rollout.settled == (False, True, True)


def test_a_hand_opens_with_the_goal_that_shows_it_open():
    goals = [resting(2.0, held_by=('left',)), resting(4.0, held_by=('left',)), resting(6.0)]
    rollout = rolled([hand(tuple(range(11)), 0.0, 1.0, (0, 0, 0.1))], goals, until=50.0,
                     settling=Settling(0.001, 0.25, 100.0))
    assert rollout.settled == (True, True, True)
    heights = rollout.chains[:, 5, 2]
    assert heights[:2] == pytest.approx([0.1, 0.1], abs=1e-9)
    assert heights[2] < -2.0


def test_a_hand_whose_last_waypoint_is_its_first_holds_as_long_as_goals_show_it():
    still = Hand('left', tuple(range(11)), 0.0, POINTS[0])
    rollout = rolled([still], [resting(2.0, held_by=('left',)), resting(4.0)], until=1.0)
    assert rollout.chains[0, :, 2] == pytest.approx(np.zeros(11), abs=1e-9)
    assert rollout.chains[1, 5, 2] < -0.01


def test_after_its_last_waypoint_a_hand_is_open_in_a_timed_goal_that_shows_it_open():
    other = hand(0, 0.0, 5.0, name='right')
    goals = [timed(2.0, held_by=('left',)), timed(3.0), timed(4.0)]
    chains = rolled([hand(8, 0.0, 1.0), other], goals).chains
    assert chains[0, 8, 2] == pytest.approx(0, abs=1e-9)
    # It opened between the first goal and the second, and sinks from then on.
    assert -0.1 - 1e-9 <= chains[1, 8, 2] <= 1e-9
    assert chains[2, 8, 2] == pytest.approx(chains[1, 8, 2] - SPEED, abs=SPEED * 2 * STEP)


def test_two_actions_with_a_stable_goal_between():
    """The waiting for the first goal takes longer than the hands did; the second action is whole."""
    first = hand(2, 0.0, 1.0, (0, 0.1, 0))
    second = Hand('left', (8,), [2.0, 3.0, 4.0], POINTS[8] + [(0, 0, 0), (0, 0.3, 0), (0, 0.3, 0.2)])
    goals = [resting(1.5), timed(2.5), timed(3.5), resting(5.0)]
    rollout = rolled([first, second], goals, until=8.0)
    assert rollout.settled == (True,) * 4
    assert rollout.chains[0, 2, 1] == pytest.approx(0.1, abs=1e-9)
    assert rollout.chains[0, 8] == pytest.approx(POINTS[8] + (0, 0, -0.8), abs=1e-9)
    assert rollout.chains[1:, 8, 1] == pytest.approx([0.15, 0.3, 0.3], abs=1e-9)
    assert rollout.chains[1:, 8, 2] == pytest.approx([-0.8, -0.7, -0.6], abs=1e-9)
    assert rollout.chains[1:, 2, 1] == pytest.approx([0.1] * 3, abs=1e-9)


def test_a_later_hand_of_the_same_name_takes_over():
    goals = [timed(1.5, held_by=('left',)), timed(2.5), timed(3.0), timed(4.0, held_by=('left',))]
    chains = rolled([hand(2, 0.0, 1.0), hand(8, 2.0, 3.0)], goals).chains
    assert chains[0, 2, 2] == pytest.approx(0, abs=1e-9)
    assert -0.1 - 1e-9 <= chains[1, 2, 2] <= -0.05 + 1e-9  # let go when the later one closed at the latest
    assert chains[2:, 2, 2] == pytest.approx(chains[1, 2, 2] - np.array([0.05, 0.15]), abs=1e-9)
    assert chains[:, 8, 2] == pytest.approx([-0.15, -0.2, -0.2, -0.2], abs=1e-9)


def test_a_hand_takes_a_point_over_from_another():
    left = Hand('left', (4,), [0.0, 1.0, 2.5], POINTS[4] + [(0, 0, 0), (0, 0.1, 0), (0, 0.1, 0)])
    right = hand(4, 2.0, 4.0, (0, 0, 0), name='right', at=POINTS[4] + (0, 0.1, 0))
    goals = [timed(1.5), timed(2.25), timed(3.0), resting(5.0, held_by=('right',))]
    chains = rolled([left, right], goals, until=4.5).chains
    assert chains[:, 4] == pytest.approx(np.tile(POINTS[4] + (0, 0.1, 0), (4, 1)), abs=1e-9)


def test_two_hands_of_one_action_move_each_on_its_own_path():
    pair = (hand(0, 0.0, 1.0, (0, 0.2, 0)), hand(10, 0.5, 2.0, (0, 0, 0.3), name='right'))
    goals = [timed(0.5), timed(1.0), resting(3.0, held_by=('left', 'right'))]
    chains = rolled([pair], goals, until=0.0).chains
    assert chains[:, 0, 1] == pytest.approx([0.1, 0.2, 0.2], abs=1e-9)
    assert chains[:, 10, 2] == pytest.approx([0, 0.1, 0.3], abs=1e-9)


def test_a_hand_that_closes_between_two_steps_still_makes_its_whole_way():
    late = hand(4, 0.5037, 1.5, (0, 0.2, 0))
    chain = rolled([late], [timed(0.3), resting(3.0, held_by=('left',))], until=0.0).chains[1]
    assert chain[4, 1] == pytest.approx(0.2, abs=1e-9)


def test_chains_have_the_observed_points_however_many_nodes_there_are():
    for nodes in (7, 31):
        rollout = rolled([hand(4, 0.0, 1.0)], [resting(2.0)], until=1.0, nodes=nodes)
        assert rollout.chains.shape == (1, 11, 3)
        assert rollout.chains[0, :, 0] == pytest.approx(POINTS[:, 0], abs=1e-9)


def test_a_path_that_does_not_fit_in_the_memory_is_refused():
    with pytest.raises(SimulationError, match="hand 'left' moves for .* time steps, more than"):
        rolled([hand(0, 0.0, 1e11)], [resting(1.5e11)])
