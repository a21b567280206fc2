# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Advice where a tracker shows the DLO all the time, and tells an action when it is over."""

from dataclasses import replace

import numpy as np
import pytest
from toy_graph import ToyGraph, TYPES
from toy_messages import SECOND, toy_trials, trial_messages
from toy_simulator import ToySimulator

from dlo_calibration import Action
from dlo_calibration.messages.codec import chain_cloud, GOAL, INITIAL
from dlo_calibration.model.chain import Chain
from dlo_calibration.planning.options import AdviceOptions
from dlo_calibration.ros.resting_place import LAID

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

RATE = 15  # chains in a second
LONG = LAID + AdviceOptions().pause + 1.0  # s that a DLO lies still
TRIAL, *_ = toy_trials(1)
START, GOAL_POINTS = TRIAL.initial.points, TRIAL.goals[-1].chain.points


class Tracked(ToyGraph):
    """A calibrator that hears a tracker."""

    def __init__(self, folder, **options):
        super().__init__(folder, lambda _: ToySimulator(), wanted='flexibility 0.01', height=0.08, **options)
        self.now = SECOND
        self._generator = np.random.default_rng(0)

    def watch(self, seconds, *places):
        """Show the DLO on its way through some places, with noise."""
        count = round(seconds * RATE)
        for share in np.linspace(0, len(places) - 1, count):
            k = min(int(share), len(places) - 2) if len(places) > 1 else 0
            points = places[k] + (share - k) * (places[min(k + 1, len(places) - 1)] - places[k])
            seen = Chain(points + self._generator.normal(0, 5e-4, points.shape))
            self.elapsed += 1 / RATE
            self.now += SECOND // RATE
            self.send([(GOAL, chain_cloud(TYPES, seen, self.now, 'world'))])
            # The thread does not know this clock.
            self.until(lambda: not self.session._live_information.alive)

    def lose(self, seconds):
        """Show nothing."""
        for _ in range(round(seconds * RATE)):
            self.elapsed += 1 / RATE
            self.now += SECOND // RATE
            self.session.tick()

    def advised(self, count):
        """Wait for what is under way, and return whether `count` advices came so far."""
        self.until(lambda: not self.session._live_information.alive)
        self.session.tick()
        return len(self.heard['advice']) == count

    def act(self):
        """Move the DLO as in the trial, with a pause, and tell the action after it."""
        hand, began, pause = TRIAL.hands[0], self.now, AdviceOptions().pause
        half = (START + GOAL_POINTS) / 2
        self.watch(1.0, START, half)
        self.watch(pause, half)
        self.watch(1.0, half, GOAL_POINTS)
        self.watch(2.0, GOAL_POINTS)
        begin, end = hand.positions
        done = Action((replace(hand, times=np.cumsum([0.0, 1.0, pause, 1.0]), orientations=None,
                               positions=[begin, (begin + end) / 2, (begin + end) / 2, end]),))
        later = replace(TRIAL.goals[-1], time=done.end + 1.0)
        self.send(trial_messages(TYPES, replace(TRIAL, actions=(done,), goals=(later,)), began)[:2])
        self.watch(2.0, GOAL_POINTS)


@pytest.fixture
def tracked(tmp_path):
    """Give a calibrator that hears a tracker."""
    graph = Tracked(tmp_path)
    yield graph
    graph.session.close()


@pytest.fixture
def asked(tracked):
    """Give a calibrator that has advised what to do with a DLO that lies still."""
    tracked.watch(LONG, START)
    assert tracked.advised(1)
    return tracked


@pytest.mark.long
def test_advice_comes_for_a_dlo_that_lies_still_and_after_an_action(tracked):
    tracked.watch(LONG, START)
    assert tracked.advised(1)
    tracked.watch(LONG, START)
    assert tracked.advised(1)
    tracked.act()
    assert tracked.advised(2)
    assert tracked.status['trials'] == '1'
    assert float(tracked.status['half_width_flexibility']) < 30  # before, 32.9
    tracked.watch(LONG, GOAL_POINTS)
    assert tracked.advised(2)


def test_a_dlo_that_is_lost_while_it_moves_asks_for_nothing(asked):
    asked.watch(0.5, START, GOAL_POINTS)
    asked.lose(2 * LONG)
    assert asked.advised(1)
    asked.watch(LONG, GOAL_POINTS)
    assert asked.advised(2)


@pytest.mark.long
def test_a_dlo_that_is_laid_elsewhere_asks_anew(asked):
    asked.act()
    assert asked.advised(2)
    elsewhere = GOAL_POINTS + (0.1, 0.1, 0.0)
    asked.watch(1.0, GOAL_POINTS, elsewhere)
    asked.watch(AdviceOptions().pause, elsewhere)
    assert asked.advised(2)
    asked.watch(LONG, elsewhere)
    assert asked.advised(3)


@pytest.mark.long
def test_a_request_to_stop_says_that_nothing_is_calibrated_and_advice_goes_on(asked):
    done, answer = asked.session.request('stop')
    assert not done and 'no calibration under way' in answer
    assert asked.advised(1)
    asked.act()
    assert asked.advised(2)


@pytest.mark.long
def test_advice_goes_on_when_the_clock_went_back(tracked):
    for count, (start, points) in enumerate(((1000, START), (10, GOAL_POINTS)), 1):
        for stamp in (start, start + 1):
            tracked.now = stamp * SECOND
            tracked.send([(INITIAL, chain_cloud(TYPES, Chain(points), tracked.now, 'world'))])
            tracked.lose(3.0)
        assert tracked.advised(count)


@pytest.mark.long
def test_one_stamp_from_the_future_does_not_silence_advice(tracked):
    now = tracked.now
    tracked.now += 1000 * SECOND
    tracked.watch(0.1, START)
    tracked.now = now
    tracked.watch(LONG, START)
    assert tracked.advised(1)
