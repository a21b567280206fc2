# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Several rollouts at once are those that each would be by itself, bit for bit."""

from concurrent.futures import CancelledError
from dataclasses import replace

from carried_trials import carried
import numpy as np
import pytest

from dlo_calibration.errors import SimulationError
from dlo_calibration.files.session import read_session, samples, session_trials
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.core import Stop
from dlo_calibration.simulation.protocol import simulate_all

PAPERS = ('flexibility', 'elasticity', 'friction', 'self_collision')
CABLES = (*PAPERS[:2], 'damping', 'internal_damping', 'torsion', 'bending_friction', 'bending_slip',
          'natural_curvature')


def drawn(names, count, seed=7, low=0.1, high=0.9):
    """Return physical values of random parameter sets."""
    space, random = ParameterSpace(names), np.random.default_rng(seed)
    return [space.physical(space.values(low + (high - low) * random.random(len(names))), 0.6)
            for _ in range(count)]


def same(simulator, jobs):
    """Yield for each job whether its rollout is the same alone and together with the others."""
    together = simulate_all(simulator, jobs, Stop())
    assert len(together) == len(jobs)
    for (trial, physical), rollout in zip(jobs, together, strict=True):
        try:
            expected = simulator.simulate(trial, physical)
        except SimulationError as error:
            yield str(error) == str(rollout)
        else:
            yield (rollout.chains.tobytes(), rollout.settled, rollout.steps, rollout.duration) == (
                expected.chains.tobytes(), expected.settled, expected.steps, expected.duration)


def turned(turn):
    """Return a trial: a cable between two hands, one of which turns about its axis by `turn` [rad]."""
    points = np.stack([np.linspace(0, 0.5, 21), np.zeros(21), np.full(21, 0.5)], axis=1)
    quaternions = [[np.sin(angle / 2), 0, 0, np.cos(angle / 2)] for angle in (0, turn / 2, turn)]
    hands = (Hand('left', (0, 1), [0.0, 0.5, 1.0], [points[0]] * 3, quaternions),
             Hand('right', (19, 20), [0.0, 1.0], [points[20], points[20] + (-0.2, 0.1, 0.0)]))
    held = {'stable': False, 'held_by': ('left', 'right')}
    goals = tuple(Goal(Chain(points), time, **held) for time in (0.5, 1.0, 1.3))
    return Trial(f'turn {turn}', Chain(points), (Action(hands),), goals)


def test_trials_on_a_table():
    simulator = CompiledSimulator(settle_limit=3.0)
    sessions = [read_session(samples() / name, None) for name in ('object2', 'object4')]
    trials = [trial for session in sessions for trial in session_trials(session, session.options)[0]]
    assert all(same(simulator, [(trial, physical) for physical in drawn(PAPERS, 3) for trial in trials]))


def test_streams_between_clamps():
    simulator = CompiledSimulator(table=False, nodes=21)
    trials = [carried(0.1, 0.2), carried(0.25, 0.0), carried(-0.1, 0.3), turned(2.0), turned(-3.0)]
    assert all(same(simulator, [(trial, physical) for physical in drawn(CABLES, 3) for trial in trials]))


def test_dlos_that_resist_twist_or_rub_beside_some_that_do_not():
    simulator = CompiledSimulator(table=False, nodes=21)
    sets = [{**physical, **changes} for physical in drawn(CABLES, 2) for changes in (
        {}, {'torsion': 0.0}, {'bending_friction': 0.0}, {'natural_curvature': 0.0},
        {'locking': 0.1}, {'locking': 0.1, 'bending_friction': 0.0},
        {'torsion': 0.0, 'natural_curvature': 0.0})]
    trials = carried(0.1, 0.2), turned(1.0)
    assert all(same(simulator, [(trial, physical) for physical in sets for trial in trials]))


def test_a_dlo_that_touches_itself_beside_one_that_does_not():
    angle = np.linspace(0, 2.2 * np.pi, 41)
    loop = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.01 + 0.002 * angle], axis=1)
    pull = Hand('hand', (0,), [0.0, 1.0], [loop[0], loop[0] + (-0.25, 0.05, 0.02)])
    tightened = Trial('loop', Chain(loop), (Action((pull,)),), (Goal(Chain(loop), 1.5),))
    straight = np.stack([np.linspace(0, 0.7, 41), np.zeros(41), np.full(41, 0.01)], axis=1)
    pulled = replace(tightened, name='line', initial=Chain(straight), actions=(Action((Hand(
        'hand', (0,), [0.0, 1.0], [straight[0], straight[0] + (-0.2, 0.05, 0.02)]),)),))
    assert all(same(CompiledSimulator(settle_limit=2.0), [
        (trial, {**physical, 'self_collision': 0.004}) for physical in drawn(PAPERS, 3)
        for trial in (tightened, pulled)]))


def test_a_diverging_rollout_does_not_affect_the_others():
    simulator = CompiledSimulator(table=False, nodes=21)
    good, = drawn(CABLES, 1)
    jobs = [(carried(0.1, 0.2), {**good, **changes}) for changes in (
        {}, {'flexibility': float('nan')}, {'damping': 2.0}, {'elasticity': float('nan')}, {'damping': 3.0})]
    together = simulate_all(simulator, jobs, Stop())
    assert [isinstance(outcome, SimulationError) for outcome in together] == [False, True, False, True, False]
    assert all(same(simulator, jobs))


def test_earlier_rollouts_make_no_difference():
    used = CompiledSimulator(table=False, nodes=21)
    trials = [carried(0.1, 0.2), replace(turned(1.0), places=np.linspace(0, 0.6, 21))]
    sets = [{}, {'elasticity': float('nan')}, {'torsion': 0.0, 'natural_curvature': 0.0},
            {'self_collision': 0.012, 'stiffness_2': 3.0}]
    jobs = [(trial, {**physical, **changes}) for physical in drawn(CABLES, 2) for trial in trials
            for changes in sets]
    for _ in range(2):
        for job, outcome in zip(jobs, simulate_all(used, jobs, Stop()), strict=True):
            new, = simulate_all(CompiledSimulator(table=False, nodes=21), [job], Stop())
            if isinstance(outcome, SimulationError):
                assert str(new) == str(outcome)
            else:
                assert new.chains.tobytes() == outcome.chains.tobytes()
        jobs.reverse()


@pytest.mark.parametrize('rows', [0, 500])
def test_scripts_that_are_too_long_for_the_cache_are_written_again(rows, monkeypatch):
    jobs = [(trial, physical) for physical in drawn(CABLES, 2) for trial in (carried(0.1, 0.2), turned(1.0))]
    expected = simulate_all(CompiledSimulator(table=False, nodes=21), jobs, Stop())
    monkeypatch.setattr('dlo_calibration.simulation.compiled.MOST_POSITIONS', rows)
    rollouts = simulate_all(CompiledSimulator(table=False, nodes=21), jobs, Stop())
    assert [one.chains.tobytes() for one in rollouts] == [one.chains.tobytes() for one in expected]


def test_a_stop_flag_ends_the_call():
    jobs = [(carried(0.1, 0.2), physical) for physical in drawn(CABLES, 8)]
    compiled, stop, begun = CompiledSimulator(table=False, nodes=21), Stop(), []

    class OneByOne:
        def simulate(self, trial, physical):
            begun.append(physical)
            if len(begun) == 3:
                stop.set()
            return compiled.simulate(trial, physical)

    with pytest.raises(CancelledError):
        simulate_all(OneByOne(), jobs, stop)
    assert len(begun) == 3
    with pytest.raises(CancelledError):
        simulate_all(compiled, jobs, stop)
