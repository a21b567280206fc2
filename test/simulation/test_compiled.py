# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The compiled engine: its steps against NumPy, and whole trials against Bullet."""

from pathlib import Path

from hypothesis import assume, given
from hypothesis import strategies as st
import numpy as np
import oracles
import pytest
from random_examples import drawing
from stepping import NO_TABLE, properties, SteppedRod, Touching
from test_rod import crumpled, GRAVITY, straight

from dlo_calibration import Action, Chain, Goal, Hand
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.model.parameters import PARAMETERS, ParameterSpace, REST_SHAPE
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation import core
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.nodes import NodeLayout

SAMPLES = Path(__file__).parents[2] / 'msg_samples'
STEP = 0.004
NAMES = tuple(parameter.name for parameter in PARAMETERS)


def some_properties(generator, curvature):
    return properties(
        10**generator.uniform(-5, -1), 10**generator.uniform(1, 4), 0.05, generator.uniform(0, 10),
        generator.uniform(0, 0.05), length_scale=generator.uniform(0.9, 1.1), natural_curvature=curvature,
        marker_mass=generator.uniform(0, 0.01), torsion=generator.uniform(0, 1),
        profile=(1.0, *generator.uniform(0.2, 5, generator.integers(0, 6))))


@drawing(40, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.integers(0, 5),
       st.one_of(st.just(0.0), st.floats(0.01, 10)), st.floats(0.02, 0.3))
def test_a_step_is_that_of_the_numpy_rod(seed, segments, held, curvature, size):
    generator = np.random.default_rng(seed)
    rest = generator.uniform(0.01, 0.05, segments)
    points = crumpled(seed, rest, size)
    count = len(points)
    tangents = np.diff(points, axis=0) / np.linalg.norm(np.diff(points, axis=0), axis=1)[:, None]
    assume((1 + (tangents[1:] * tangents[:-1]).sum(axis=1).min()) / 2 > oracles.HAIRPIN)
    velocities = generator.normal(size=points.shape)
    nodes = np.sort(generator.choice(count, min(held, count - 1), replace=False))
    follow = generator.normal(size=(len(nodes), 3))
    rod = SteppedRod(rest, some_properties(generator, curvature), STEP, generator.uniform(0, 1, count))
    rod.hold(nodes)
    simulated = rod.velocities(points, velocities, GRAVITY, follow)
    expected = oracles.rod_velocities(rod.state, points, velocities + STEP * GRAVITY)
    assert np.abs(simulated - expected).max() < 1e-8 * max(1, np.abs(expected).max())


@drawing(40, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(8, 30), st.floats(0.003, 0.02), st.floats(0, 2), st.booleans())
def test_contacts_are_those_of_the_numpy_capsules(seed, segments, radius, friction, supported):
    generator = np.random.default_rng(seed)
    rest = np.full(segments, 0.02)
    turns = np.cumsum(generator.normal(0, 0.6, segments))  # a tangle in a thin layer
    points = np.concatenate([[[0.0, 0, 0]], np.cumsum(0.02 * np.stack(
        [np.cos(turns), np.sin(turns), generator.normal(0, 0.2, segments)], axis=1), axis=0)])
    velocities = generator.normal(0, 0.5, points.shape)
    inverse = generator.uniform(0.5, 2, len(points)) * (generator.random(len(points)) > 0.1)
    support = generator.normal(0, 0.05, points.shape) * supported
    places = np.concatenate([[0.0], np.cumsum(rest)])
    begun = points + generator.normal(0, 0.002, points.shape)
    touching = Touching(places, radius, friction, STEP)
    touching.start(begun)
    expected = oracles.without_penetration(
        places, begun, radius, friction, points, velocities, inverse, support, STEP)
    simulated = touching.velocities(points, velocities, inverse, support)
    assert simulated == pytest.approx(expected, abs=1e-9)


def sample(name, marked=()):
    """Return the trials of a sample, with some points marked as features, and its options."""
    session = read_session(SAMPLES / name, None)
    options = session.options
    trials, _ = session_trials(session, options)
    features = np.isin(np.arange(len(trials[0].initial)), marked)
    return [Trial(trial.name, Chain(trial.initial.points, trial.initial.hands, features), trial.actions,
                  trial.goals, trial.velocity) for trial in trials], options


@pytest.mark.parametrize('name', ['object2', 'object4'])
def test_rollouts_are_those_of_bullet(name):
    trials, options = sample(name, (3, 10))
    generator = np.random.default_rng(5)
    space = ParameterSpace(NAMES, {}, options.mass)
    with_table = {'table': True, 'table_height': options.table_height, 'settle_limit': 1.0}
    bullet, compiled = BulletSimulator(**with_table), CompiledSimulator(**with_table)
    for trial in trials[:3]:
        # Rounding decides to which side a DLO buckles if it is too long for its place, where it is flung if
        # it is far more curved at rest, and whether strands stick or slip.
        point = generator.random(len(NAMES)) + space.upper - 1
        values = {**space.values(point), 'length_scale': generator.uniform(30, 48),
                  'natural_curvature': generator.uniform(0, 20), 'bending_friction': 0.0,
                  'locking': 0.0,
                  **dict(zip(REST_SHAPE[1:], generator.uniform(48, 52, len(REST_SHAPE) - 1), strict=True))}
        physical = {**space.physical(values, trial.initial.length), 'self_collision': 0.004}
        expected, rollout = (engine.simulate(trial, physical) for engine in (bullet, compiled))
        assert np.linalg.norm(rollout.chains - expected.chains, axis=-1).mean() < 1e-6
        assert (rollout.steps, rollout.settled) == (expected.steps, expected.settled)
    bullet.close()


def test_a_dragged_rope_lies_where_shorter_steps_leave_it():
    points = np.column_stack([np.linspace(0, 0.6, 21), np.zeros(21), np.full(21, 0.0039)])
    way = np.array([points[20], (0.55, 0.12, 0.0239), (0.36, 0.12, 0.0239), (0.26, 0.02, 0.0239)])
    action = Action((Hand('right', (20,), (0.0, 1.0, 2.2, 3.0), way),))
    goal = Goal(Chain(points), 3.0, False, ('right',))
    trial = Trial('trial 1', Chain(points), (action,), (goal,))
    physical = ParameterSpace(mass=0.03).physical({'flexibility': 72.6, 'friction': 56.7}, 0.6)
    fine, usual = (CompiledSimulator(time_step=step).simulate(trial, physical).chains[0]
                   for step in (5e-4, 3e-3))
    assert np.linalg.norm(fine - points, axis=1).mean() > 0.08
    assert np.linalg.norm(usual - fine, axis=1).mean() < 1.5e-3


def test_a_rollout_that_diverges_ends_at_once():
    rest = np.full(10, 0.05)
    points = straight(rest)
    start = core.Start(points[:, 0], points, 1e200 * crumpled(0, rest))
    script = core.Script([core.Event.advance([], 10**9), core.Event.see()], 1e-3, 50)
    physical = ParameterSpace().physical({}, 0.5)
    assert core.roll_out([(script, start, physical, NO_TABLE)], STEP) == [None]


def test_trials_that_differ_in_features_only_have_layouts_of_their_own():
    trials, options = sample('object2')
    simulator = CompiledSimulator(settle_limit=0.5)
    physical = ParameterSpace(mass=options.mass).physical({}, 0.5)
    first = simulator.simulate(trials[0], physical).chains
    other = sample('object2', (5,))[0][0]
    heavy = simulator.simulate(other, {**physical, 'marker_mass': 0.1}).chains
    assert np.abs(heavy - first).max() > 1e-4
    assert NodeLayout.of(other, 31).features.sum() == pytest.approx(1)
    simulator.close()
    assert simulator.simulate(trials[0], physical).chains.tobytes() == first.tobytes()
