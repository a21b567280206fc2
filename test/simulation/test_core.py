# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The core's interface: the same bits everywhere, an end on request, and no input that does harm."""

from concurrent.futures import ThreadPoolExecutor
import functools
import math
import random
import re
import time
from types import MappingProxyType

from carried_trials import carried
from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from stepping import NO_TABLE, properties
from test_together import CABLES, drawn, PAPERS, turned

from dlo_calibration.files.session import read_session, samples, session_trials
from dlo_calibration.simulation import core
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.core import Stop
from dlo_calibration.simulation.protocol import simulate_all

STEP = 0.004
DOWN = (0.0, 0.0, -9.81)


def on_a_table():
    """Return a simulator, and jobs for it: samples."""
    sessions = [read_session(samples() / name, None) for name in ('object2', 'object4')]
    trials = [trial for session in sessions for trial in session_trials(session, session.options)[0][:2]]
    jobs = [(trial, physical) for physical in drawn(PAPERS, 2) for trial in trials]
    return CompiledSimulator(settle_limit=1.0), jobs


def between_clamps():
    """Return a simulator, and jobs for it: cables of strands, coiled, in clamps that turn; timed goals."""
    trials = turned(2.0), carried(0.1, 0.2), turned(-3.0)
    jobs = [(trial, physical) for physical in drawn(CABLES, 2) for trial in trials]
    return CompiledSimulator(table=False, nodes=21), jobs


def bits(rollout):
    return rollout.chains.tobytes(), rollout.settled, rollout.steps


@pytest.mark.parametrize('some', [on_a_table, between_clamps])
def test_every_processor_gives_the_same_bits_alone_and_together(some, monkeypatch):
    simulator, jobs = some()
    expected = [bits(simulator.simulate(*job)) for job in jobs]
    assert core.TARGETS[-1] == 'baseline'
    roll_out = core.roll_out
    for target in core.TARGETS:
        monkeypatch.setattr(core, 'roll_out', functools.partial(roll_out, target=target))
        assert [bits(simulator.simulate(*job)) for job in jobs] == expected
        assert [bits(one) for one in simulate_all(simulator, jobs, Stop())] == expected


@pytest.mark.parametrize('some', [on_a_table, between_clamps])
def test_threads_that_share_a_simulator_do_not_affect_each_other(some):
    simulator, jobs = some()
    expected = [bits(one) for one in simulate_all(simulator, jobs, Stop())]
    simulator.close()
    with ThreadPoolExecutor(4) as threads:
        alone = threads.map(lambda job: bits(simulator.simulate(*job)), jobs)
        together = threads.map(
            lambda _: [bits(one) for one in simulate_all(simulator, jobs, Stop())], range(4))
        assert list(alone) == expected
        assert list(together) == [expected] * 4


def start(nodes=5, **others):
    """Return the start of a DLO that lies straight along x."""
    places = 0.05 * np.arange(nodes)
    points = places[:, None] * (1.0, 0, 0)
    return core.Start(**{'places': places, 'points': points, 'velocities': 0 * points, **others})


CABLE = properties(1e-3, 1e3, 0.02, 1.0, 0.01, torsion=0.7, natural_curvature=1.0, bending_friction=0.5,
                   locking=0.05)


@pytest.mark.parametrize('count', [1, 5])
def test_a_stop_in_another_thread_ends_a_billion_steps(count):
    script = core.Script([core.Event.advance([], 10**9), core.Event.see()], 1e-3, 50)
    stop, jobs = Stop(), [(script, start(), CABLE, 0.0)] * count
    with ThreadPoolExecutor(1) as thread:
        under_way = thread.submit(core.roll_out, jobs, STEP, stop)
        time.sleep(0.1)  # would never return if the rollout kept Python's lock
        assert not under_way.done() and not stop.is_set()
        stop.set()
        under_way.result(timeout=2)
    assert stop.is_set()


def in_clamps(across, twist=0.0):
    """Return the state of a straight DLO along x in two clamps; `across` is (2,), along y and z."""
    places = 0.5 * np.arange(6.0)
    points = places[:, None] * (1.0, 0, 0)
    physical = properties(1e-3, 1e3, 0.02, torsion=0.7, rest_curvature=[(0.0, 0.0)] * 2, clamp_twist=twist)
    begun = core.Start(places, points, 0 * points, None, np.tile((0.0, *across), (5, 1)))
    rope = core.Rope(begun, physical, STEP, NO_TABLE, np.zeros(3))
    rope.hold([0, 1, 4, 5])
    rope.aim(points[rope.held])
    before = dict(rope.state['clamps'])
    assert rope.predict()
    return before, rope.state['angles']


@given(st.floats(-6000.0, 6000.0))
def test_sine_and_cosine_are_those_of_the_library(angle):
    _, cosine, sine = in_clamps((1.0, 0.0), angle)[0][4]
    assert (cosine, sine) == pytest.approx((math.cos(angle), math.sin(angle)), rel=0, abs=4e-16)


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
@example(948292656.2924843, 590466524.3793352)
def test_the_angle_of_a_vector_is_that_of_the_library(y, z):
    # The frame begins along z and turns to -y.
    expected = math.atan2(0.0 - y, z) if y or z else 0.0  # pi, also where y is -0.0
    # To two units in the last place.
    assert in_clamps((y, z))[1][0] == pytest.approx(expected, rel=2 * np.finfo(float).eps, abs=4e-16)


NUMBERS = (0.0, -1.0, 1e-300, 1e6, 1e200, -1e308, np.nan, np.inf, -np.inf, None, 'much', 10**400)
INDICES = (-1, 0, 1, 2, 9, 9999, 10**4, 2**31 - 1, 2**31, -2**31, 10**30, None, 0.5, 'one')


class Wild:
    """Makes the parts of a script and a DLO; a share `rate` of them is invalid or unusual."""

    def __init__(self, seed, rate):
        self._random, self._rate = random.Random(seed), rate

    def _other(self):
        return self._random.random() < self._rate

    def number(self, usual):
        return self._random.choice(NUMBERS) if self._other() else usual

    def index(self, usual):
        return self._random.choice(INDICES) if self._other() else usual

    def list(self, usual):
        if self._other():
            return self._random.choice([None, [], usual[:-1], [*usual, *usual[-1:]], usual[::-1], [None], 3])
        return usual

    def array(self, usual):
        usual = np.array(usual, float)
        if self._other():
            return self._random.choice([
                None, usual[:-1], usual[..., :-1], usual.ravel(), usual[:0], usual.T, np.zeros_like(usual),
                3.0, 'rope', -usual, usual + 1e200])
        if self._other() and usual.size:
            usual.ravel()[self._random.randrange(usual.size)] = self._random.choice(NUMBERS[:9])
        return usual

    def nodes(self, *usual):
        return self.list([self.index(node) for node in usual])

    def grip(self, rows, steps):
        turn = np.eye(3)[[0, 0, 0]] if self._other() else [
            [1, 0, 0], [0, math.cos(0.1), -math.sin(0.1)], [0, math.sin(0.1), math.cos(0.1)]]
        turns = np.tile(np.ravel(turn), (steps, 1))
        return core.Grip(self.nodes(*rows), self.array(np.zeros((steps, 3))),
                         self.array(turns) if self._other() else None, self.array(turns))

    def script(self):
        count = self._random.choice([-2**31, 0, 2**31, None]) if self._other() else 5
        settling = self._random.choice([0, -1, 4, 5, 10**8, 2**31 - 1, 2**31]) if self._other() else 6
        event = core.Event
        events = [
            event.close(self.index(0), self.nodes(0, 1), self.array((0.0, 0.0, 0.01))),
            event.hold(self.nodes(0, 1)),
            event.advance(self.list([self.grip((0, 1), 3)]), count, bool(self._other()), bool(self._other()),
                          self.list([(self.index(k), self.number(0.3)) for k in (0, 0, 2, 5)])),
            event.see(self.number(0.5)),
            event.close(self.index(2), self.nodes(3, 4), self.array(np.zeros(3))),
            event.hold(self.nodes(0, 1, 3, 4)),
            event.advance(self.list([self.grip((0, 1), 2), self.grip((2, 3), 1)]), 4),
            event.hold([]),
            event.advance([], 20, True),
            event.see()]
        if self._other():
            self._random.shuffle(events)
        return core.Script(self.list(events), self.number(1e-3), settling, bool(self._other()))

    def start(self):
        places = np.linspace(0, 0.2, 5)
        points = np.stack([0.04 * np.cos(9 * places), 0.04 * np.sin(9 * places), 0 * places], axis=1)
        return core.Start(
            self.array(places), self.array(points), self.array(0 * points),
            self.array(np.ones(5)) if self._other() else None,
            self.array(np.tile((0.0, 0.0, 1.0), (4, 1))) if self._other() else None)

    def physical(self):
        usual = {**CABLE, 'self_collision': 0.01, 'friction': 0.4, 'rest_curvature_x1': 1.0,
                 'rest_curvature_y1': 0.0, 'rest_curvature_x2': 1.0, 'rest_curvature_y2': 2.0,
                 'stiffness_2': 2.0, 'length_scale': 1.0, 'marker_mass': 0.001, 'clamp_twist': 0.1}
        if self._other():
            return self.list([
                {name: self.number(value) for name, value in usual.items() if not self._other()}])
        return {name: self.number(value) for name, value in usual.items()}


def call(act):
    """Return the result of a call; None if the core refuses its input with an error that names it."""
    try:
        return act()
    except (KeyError, TypeError, ValueError) as error:
        assert re.search(r'^\w+: .+; expected .+; .+|incompatible|object|^\'\w+\'$', str(error)), error
        return None


def octets(outcome):
    """Return all that an outcome holds, comparable bit for bit."""
    return outcome and [part.tobytes() if isinstance(part, np.ndarray) else part for part in outcome]


@drawing(300)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.005, 0.02, 0.1]))
def test_any_input_is_refused_or_simulated(seed, rate):
    wild = Wild(seed, rate)

    def some():
        return wild.script(), wild.start(), wild.physical(), wild.number(0.0), wild.number(STEP)

    given = call(some)
    if given is None:
        return
    script, begun, physical, level, step = given
    outcomes = [call(lambda target=target, count=count: core.roll_out(
        [(script, begun, physical, level)] * count, step, target=target))
        for target in core.TARGETS for count in (1, 4)]
    contents = {str(outcome and [octets(first) for first in outcome[:1]]) for outcome in outcomes}
    assert len(contents) == 1
    if outcomes[0] is None:
        assert rate
        return
    assert outcomes[0][0] is None or np.isfinite(outcomes[0][0][0]).all()
    rope = call(lambda: core.Rope(begun, physical, step, level, DOWN))
    followed = rope.follow(script, rope.step)
    assert (followed is None) == (outcomes[0][0] is None)
    assert octets(followed) == octets(outcomes[0][0])


def clamped():
    """Return a script of three steps in which a hand holds a clamp."""
    grip = core.Grip([0, 1], np.zeros((1, 3)), None, np.eye(3).reshape(1, 9))
    close, hold, advance = core.Event.close, core.Event.hold, core.Event.advance
    return core.Script([close(0, [0, 1], np.zeros(3)), hold([0, 1]), advance([grip], 3)], 1e-3, 5)


@drawing(100)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 0.1]))
def test_a_rope_survives_any_sequence_of_calls(seed, rate):
    wild, choice = Wild(seed, rate), random.Random(seed)
    rope = core.Rope(start(), {**CABLE, 'self_collision': 0.01}, STEP, 0.0, DOWN)
    script = clamped() if seed % 2 else core.Script([core.Event.advance([], 3), core.Event.see()], 1e-3, 5)
    acts = [
        rope.step, rope.predict, lambda: rope.state,
        lambda: rope.hold(wild.nodes(0, 1)), lambda: rope.hold(wild.nodes(2, 3, 4)),
        lambda: rope.aim(wild.array(rope.targets)),
        lambda: rope.aim(wild.array(rope.targets), wild.array([np.eye(3).ravel()] * len(rope.held))),
        lambda: rope.points.__setitem__(choice.randrange(5), choice.choice(NUMBERS[:9])),
        lambda: rope.follow(script, choice.choice([rope.step, rope.predict]))]
    for _ in range(30):
        call(choice.choice(acts))
    assert rope.targets.shape == (len(rope.held), 3) and rope.points.shape == (5, 3)


def test_while_a_rope_follows_a_script_no_other_call_holds_or_aims_it():
    rope = core.Rope(start(), CABLE, STEP, 0.0, DOWN)
    script = clamped()
    for act in (lambda: rope.hold([2]), lambda: rope.aim(rope.targets),
                lambda: rope.follow(script, rope.step)):
        with pytest.raises(ValueError, match='rope: .* while it follows a script'):
            rope.follow(script, act)
    rope.hold([2])
    rope.aim(np.zeros((1, 3)))


def test_refused_targets_change_nothing():
    rope = core.Rope(start(), CABLE, STEP, 0.0, DOWN)
    rope.hold([0, 1])
    aims = rope.points[:2] + 0.001
    rope.aim(aims)
    for wrong in ((aims[:1],), (aims, np.zeros((1, 9))), (np.full((2, 3), np.nan),)):
        with pytest.raises(ValueError, match='(targets|turns): .*; expected '):
            rope.aim(*wrong)
    assert rope.targets.tolist() == aims.tolist()


def test_physical_parameters_may_be_any_mapping_of_numbers():
    script = core.Script([core.Event.advance([], 3), core.Event.see()], 1e-3, 5)

    def nodes(physical):
        return core.roll_out([(script, start(), physical, 0.0)], STEP)[0][0]

    others = MappingProxyType({name: np.float32(value) for name, value in CABLE.items()})
    assert nodes(others) == pytest.approx(nodes(CABLE), abs=1e-6)
    for wrong, error, text in (({**CABLE, 'mass': 'light'}, TypeError, 'mass: no number; expected one in SI'),
                               ({'flexibility': 1.0}, KeyError, 'elasticity'),
                               ([CABLE], TypeError, 'physical: no mapping; expected numbers by')):
        with pytest.raises(error, match=text):
            nodes(wrong)
