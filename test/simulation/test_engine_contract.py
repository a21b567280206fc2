# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""One contract for every engine: analytic solutions, repeatable rollouts, and refusals."""

from contextlib import closing
import functools
import hashlib
import itertools
import json
from pathlib import Path
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from dlo_calibration import Action, Chain, Goal, Hand, SimulationError, Trial
from dlo_calibration.model.parameters import CLAMP_BENDS, HANDS, PARAMETERS, ParameterSpace
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator

LONG = functools.partial(pytest.param, marks=pytest.mark.long)
#: Each takes what `BulletSimulator` takes, but a scene.
FACTORIES = (BulletSimulator, CompiledSimulator)

GRAVITY = 9.81
NODES, TIME_STEP = 31, 0.004  # fewer than by default, and longer: it is quicker
STIFF = {'flexibility': 1e-3, 'elasticity': 1e4, 'friction': 0.4, 'self_collision': 0.005, 'mass': 0.05,
         'damping': 5.0, 'internal_damping': 1e-3}
PHYSICAL = {**STIFF, 'flexibility': 1e-4, 'mass': 0.03, 'damping': 1.0, 'internal_damping': 1e-4}
SPACE = ParameterSpace(tuple(parameter.name for parameter in PARAMETERS))
NEUTRAL = {parameter.name: parameter.default for parameter in PARAMETERS[7:]}  # of an even, straight DLO
MIDDLE = {**dict.fromkeys(SPACE.free, 50.0), 'natural_curvature': 20.0, 'flexibility': 72.3,
          'elasticity': 40.0, 'friction': 60.0, 'self_collision': 25.0, 'damping': 50.0,
          'internal_damping': 0.0, 'locking': 0.0, 'mass': 40.0}

BY_CLAMPS = ('clamp_twist', *CLAMP_BENDS)  # what only trials with clamps show


def each_engine(*names_and_values):
    """Parametrize a test: names, their values for all engines, and values that take long with Bullet."""
    *names, values, others = names_and_values
    others = list(others)
    return pytest.mark.parametrize(('make', *names), [
        *((factory, *case) for case in values for factory in FACTORIES),
        *((CompiledSimulator, *case) for case in others),
        *(LONG(BulletSimulator, *case) for case in others)], indirect=['make'])


@pytest.fixture(params=FACTORIES, ids=lambda factory: factory.name)
def make(request):
    """Give a function that makes simulators of one engine, which are closed at the end."""
    made = []

    def make(**settings):
        made.append(request.param(**{'nodes': NODES, 'time_step': TIME_STEP, **settings}))
        return made[-1]

    yield make
    for simulator in made:
        simulator.close()


def line(start, direction, length, count):
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    return np.asarray(start, float) + np.linspace(0, length, count)[:, None] * direction


def held(points, *grips):
    """Return a trial in which hands hold points, each hand those of one tuple, until the DLO rests."""
    hands = tuple(Hand(f'hand {k}', grip, [0.0, 0.1], [points[grip[0]]] * 2) for k, grip in enumerate(grips))
    chain = Chain(points)
    return Trial('held', chain, (Action(hands),),
                 (Goal(chain, 0.2, held_by=tuple(hand.name for hand in hands)),))


def settled(make, trial, physical, nodes, limit=120.0):
    """Return the points at rest: nothing moved more than 10 micrometres in 0.25 s."""
    simulator = make(table=False, nodes=nodes, stable_distance=1e-5, settle_limit=limit)
    end = simulator.simulate(trial, physical)
    assert all(end.settled), 'the rope never came to rest'
    return end.chains[-1]


@functools.cache
def elastica_tip(stiffness, load, length):
    """Return the tip (x, z) of a horizontal cantilever under its own weight `load` [N/m]: the elastica."""
    def slope(s, y):
        return np.stack([y[1], -load * (length - s) * np.cos(y[0]) / stiffness, np.cos(y[0]), np.sin(y[0])])

    def ends(a, b):
        return np.array([a[0], b[1], a[2], a[3]])

    s = np.linspace(0, length, 200)
    guess = np.zeros((4, len(s)))
    guess[2] = s
    for part in np.linspace(0.02, 1, 25):
        growing = np.array([[1], [part], [1], [1]])
        solution = solve_bvp(lambda s, y, growing=growing: slope(s, y) * growing, ends, s, guess,
                             tol=1e-6, max_nodes=20000)
        s, guess = solution.x, solution.y
    assert solution.success
    return np.array([solution.y[2, -1], -solution.y[3, -1]])


@each_engine('stiffness', 'count', itertools.product((0.05, 0.005), (12, 31)), itertools.chain(
    itertools.product((0.5,), (12, 31)), itertools.product((0.5, 0.05, 0.005), (50,))))
def test_cantilever_tip_is_the_elastica(make, stiffness, count):
    clamp = 0.01
    places = np.append(0.0, clamp + np.linspace(0, 1, count - 1))
    points = np.stack([places - clamp, 0 * places, 0 * places], axis=1)
    tip = settled(make, held(points, (0, 1)),
                  {**STIFF, 'flexibility': stiffness, 'mass': 0.05 * places[-1]}, count)[-1]
    expected = elastica_tip(stiffness, 0.05 * GRAVITY, 1.0)
    deflection = np.linalg.norm([1, 0] - expected)
    assert np.linalg.norm(tip[[0, 2]] - expected) < (0.02 if count < 20 else 0.003) * deflection
    assert abs(tip[1]) < 1e-9


@each_engine('stiffness', [(50.0,)], [(5.0,), (5000.0,)])
def test_hanging_rope_stretches_under_its_weight(make, stiffness):
    points = line((0, 0, 2), (0, 0, -1), 1.0, 31)
    stretch = 1.0 - settled(make, held(points, (0,)), {**STIFF, 'elasticity': stiffness}, 31)[-1, 2]
    # Hooke: the tension at s is m g (1 - s / L), so that the stretch is m g L / (2 EA).
    assert stretch == pytest.approx(0.05 * GRAVITY / (2 * stiffness), rel=0.01)


def test_limp_rope_hangs_in_a_catenary(make):
    half = brentq(lambda angle: np.sin(angle) / angle - 0.7, 0.1, 3.0)  # of an arc 1 m long over 0.7 m
    turn = np.linspace(-half, half, 51)
    points = np.stack([np.sin(turn), 0 * turn, np.cos(half) - np.cos(turn)], axis=1) / (2 * half)
    span, length = 0.7, Chain(points).length
    a = brentq(lambda a: 2 * a * np.sinh(span / 2 / a) - length, 0.05, 5)
    sag = a * (np.cosh(span / 2 / a) - 1)
    chain = settled(make, held(points, (0,), (50,)), {**STIFF, 'flexibility': 1e-6}, 51)
    assert -chain[:, 2].min() == pytest.approx(sag, rel=0.006)


@each_engine('friction', [(0.4,)], [(0.1,), (1.0,)])
def test_pulling_a_rope_over_a_table_takes_its_friction(make, friction):
    stiffness = 20.0  # N, soft, so that its stretch is a measure of the force
    points = line((0, 0, 0.005), (1, 0, 0), 1.0, 31)
    pull = Hand('hand', (30,), [0.0, 5.0], [points[30], points[30] + (0.5, 0, 0)])
    goal = Goal(Chain(points), 4.9, stable=False, held_by=('hand',))
    chain = make(table=True).simulate(
        Trial('pull', Chain(points), (Action((pull,)),), (goal,)),
        {**STIFF, 'elasticity': stiffness, 'friction': friction, 'damping': 0.01}).chains[0]
    # The force at s is mu m g s / L, so that the stretch is mu m g L / (2 EA); the held node slides too.
    stretch = chain[30, 0] - chain[0, 0] - 1.0
    assert stretch == pytest.approx(friction * 0.05 * GRAVITY / (2 * stiffness), rel=0.05)


def test_a_rope_on_a_table_stays_where_friction_holds_it(make):
    bend = np.linspace(0, np.pi / 2, 31)
    points = np.stack([0.6 * np.sin(bend), 0.6 * (1 - np.cos(bend)), 0 * bend + 0.005], axis=1)
    hand = Hand('hand', (0,), [0.0, 0.1], [points[0]] * 2)
    goal = Goal(Chain(points), 8.0, stable=False, held_by=('hand',))
    chain = make().simulate(Trial('lie', Chain(points), (Action((hand,)),), (goal,)),
                            {**STIFF, 'flexibility': 1e-5}).chains[0]
    assert np.abs(chain - points).max() < 2e-4


@each_engine('radius', [(0.002,)], [(0.015,)])
def test_legs_laid_across_each_other_do_not_pass_through(make, radius):
    # A loop: the last leg lies 6 cm above the first, across it, and falls onto it while it is pulled.
    turn = np.linspace(-np.pi / 2, np.pi, 40)
    loop = np.stack([0.12 + 0.1 * np.cos(turn), 0.1 * np.sin(turn) + 0.1, 0 * turn], axis=1)
    first = line((-0.3, 0, 0), (1, 0, 0), 0.41, 15)[:-1]
    last = line((0.02, 0.09, 0), (0, -1, 0), 0.3, 12)
    points = np.concatenate([first, loop, last]) + (0, 0, radius)
    points[14:54, 2] += np.linspace(0, 0.06, 40)
    points[54:, 2] += 0.06
    assert crossing_side(points) > 0.05  # the last leg is above the first
    end = len(points) - 1
    path = [points[end], points[end] + (0, -0.04, -0.06), points[end] + (0, -0.15, -0.06)]
    hands = (Hand('first', (0,), [0.0, 7.5], [points[0]] * 2), Hand('last', (end,), [0.0, 2.0, 7.5], path))
    goals = tuple(Goal(Chain(points), t, stable=False, held_by=('first', 'last'))
                  for t in np.arange(0.05, 7.5, 0.05))
    chains = make(nodes=61).simulate(
        Trial('cross', Chain(points), (Action(hands),), goals),
        {**STIFF, 'flexibility': 1e-4, 'self_collision': radius}).chains
    assert min(crossing_side(chain) for chain in chains) > 0.5 * radius
    assert crossing_side(chains[-1]) > 1.5 * radius


def crossing_side(points):
    """Return the height of the later over the earlier of two crossing segments, seen from above."""
    i, j = np.triu_indices(len(points) - 1, 2)
    along = np.diff(points, axis=0)
    a, b, d = along[i].T, along[j].T, (points[j] - points[i]).T
    with np.errstate(divide='ignore', invalid='ignore'):  # parallel ones
        s, t = np.array([d[1] * b[0] - d[0] * b[1], a[0] * d[1] - a[1] * d[0]]) / (a[1] * b[0] - a[0] * b[1])
    cross = (0 <= s) & (s <= 1) & (0 <= t) & (t <= 1)
    assert cross.any(), 'the legs do not cross'
    return (d[2] + t * b[2] - s * a[2])[cross][0]


def test_damping_does_not_move_the_resting_shape(make):
    trial = held(line((0, 0, 0), (1, 0, 0), 1.0, 31), (0, 1), (30,))
    stiff = {**STIFF, 'flexibility': 1e-2}
    shapes = [settled(make, trial, {**stiff, 'damping': drag, 'internal_damping': internal}, 31)
              for drag, internal in ((0.5, 1e-4), (5.0, 1e-4), (5.0, 3e-2))]
    assert shapes[0][:, 2].min() < -0.01
    assert np.abs(shapes[1] - shapes[0]).max() < 2e-4
    assert np.abs(shapes[2] - shapes[0]).max() < 2e-4


def drag_trial(height=0.004, noise=0.0):
    """Return a trial: a hand drags a point of a slightly bent rope sideways on a table."""
    generator = np.random.default_rng(3)
    x = np.linspace(0, 0.6, 21)
    points = np.stack([x, 0.03 * np.sin(8 * x), 0 * x + height], axis=1)
    points = points + noise * generator.standard_normal(points.shape)
    hand = Hand('hand', (5,), [0.0, 1.0], [points[5], points[5] + (0.02, 0.1, 0)])
    return Trial('drag', Chain(points), (Action((hand,)),), (Goal(Chain(points), 3.0),))


def fold_trial(held_by=(), clamps=False):
    """Return a trial: a hand lays the end of a short rope across its beginning, so that it touches itself."""
    x = np.linspace(0, 0.4, 15)
    points = np.stack([x, 0.01 * np.sin(8 * x), 0 * x + 0.005], axis=1)
    path = [points[14], (0.35, -0.02, 0.06), (0.2, -0.06, 0.06), (0.1, 0.04, 0.02)]
    hand = Hand('hand', (13, 14) if clamps else (14,), [0.0, 0.3, 0.8, 1.1], path)
    other = Hand('other', (0, 1) if clamps else (0,), [0.0, 1.1], [points[0]] * 2)
    goals = (Goal(Chain(points), 0.5, stable=False), Goal(Chain(points), 2.0, held_by=held_by))
    marked = Chain(points, features=np.arange(15) == 7)
    return Trial('fold', marked, (Action((hand, other)),), goals)


SMALL = {'nodes': 21, 'settle_limit': 1.0}


def rollout(simulator, trial=fold_trial(), **values):  # noqa: B008  a trial is frozen
    return simulator.simulate(trial, SPACE.physical({**MIDDLE, **values}, 0.4))


def test_a_rollout_has_finite_chains_at_every_goal(make):
    result = rollout(make(**SMALL))
    assert result.chains.shape == (2, 15, 3)
    assert np.isfinite(result.chains).all()
    assert len(result.settled) == 2
    assert result.settled[0]
    assert result.steps > 0
    assert result.duration == pytest.approx(result.steps * TIME_STEP)
    with pytest.raises(ValueError):
        result.chains[0] = 0
    # The hand was there at half a second: two fifths of the way from its second waypoint to its third.
    assert result.chains[0, 14] == pytest.approx((0.29, -0.036, 0.06), abs=2e-3)


def test_the_same_call_gives_the_same_rollout_bit_for_bit(make):
    simulator = make(**SMALL)
    first = rollout(simulator)
    rollout(simulator, fold_trial(held_by=('hand',)), friction=5.0, self_collision=60.0)
    rollout(simulator, drag_trial(), flexibility=37.7)
    again = rollout(simulator)
    fresh = rollout(make(**SMALL))
    assert first.chains.tobytes() == again.chains.tobytes() == fresh.chains.tobytes()
    assert first.steps == again.steps == fresh.steps


@pytest.fixture(scope='module')
def elsewhere():
    """Return the digests of a rollout with each engine in another process, by engine."""
    code = ('import json, sys; sys.path[:0] = sys.argv[1:]\n'
            'from test_engine_contract import *\n'
            'print(json.dumps({make.name: digest(rollout(make(time_step=TIME_STEP, **SMALL)))\n'
            '                  for make in FACTORIES}))')
    tests = Path(__file__).parents[1]
    printed = subprocess.run(
        [sys.executable, '-c', code, *(str(tests / name) for name in ('simulation', 'support'))],
        capture_output=True, text=True, check=True).stdout
    return json.loads(printed.splitlines()[-1])


def test_a_repeat_is_bit_exact_in_another_process(make, elsewhere):
    here = make(**SMALL)
    assert elsewhere[here.name] == digest(rollout(here))


def digest(rollout):
    return hashlib.sha256(rollout.chains.tobytes()).hexdigest()


def test_the_order_of_trials_does_not_matter(make):
    there, back = make(**SMALL), make(**SMALL)
    trials = [fold_trial(), drag_trial(), fold_trial(held_by=('hand',))]
    forward = [rollout(there, trial).chains.tobytes() for trial in trials]
    backward = [rollout(back, trial).chains.tobytes() for trial in trials[::-1]]
    assert forward == backward[::-1]


def test_an_engine_can_be_pickled_before_and_after_use(make):
    engine = make(**SMALL)
    unused = pickle.loads(pickle.dumps(engine))  # noqa: S301
    first = rollout(engine)
    used = pickle.loads(pickle.dumps(engine))  # noqa: S301
    for copy in (unused, used):
        assert rollout(copy).chains.tobytes() == first.chains.tobytes()
        copy.close()
    assert rollout(engine).chains.tobytes() == first.chains.tobytes()


def test_a_closed_engine_can_be_used_again(make):
    engine = make(**SMALL)
    engine.close()
    first = rollout(engine)
    engine.close()
    engine.close()
    assert rollout(engine).chains.tobytes() == first.chains.tobytes()


def test_two_engines_do_not_affect_each_other(make):
    engine, other = make(**SMALL), make(**SMALL)
    alone = rollout(engine)
    rollout(other, friction=5.0)
    assert rollout(engine).chains.tobytes() == alone.chains.tobytes()
    other.close()
    assert rollout(engine).chains.tobytes() == alone.chains.tobytes()


@functools.cache
def chains_of(factory, **changed):
    """Return the chains of a rollout with some parameters changed; with clamps for what only they show."""
    clamps = not {'torsion', *BY_CLAMPS}.isdisjoint(changed)
    with closing(factory(time_step=TIME_STEP, **{**SMALL, 'nodes': 15 if clamps else 21})) as engine:
        # With no node between the points that clamps hold.
        given = fold_trial(('hand', 'other'), clamps=True) if clamps else fold_trial()
        return rollout(engine, given, **changed).chains


def tried_parameters():
    """Give engines and parameters; of those that differ in a number only, the first is enough for Bullet."""
    for parameter in PARAMETERS:
        if parameter.name in HANDS:
            continue  # they move the hands of a trial before an engine simulates it
        yield CompiledSimulator, parameter.name
        several = re.search('[3-9]$|[xy]2$', parameter.name)
        yield LONG(BulletSimulator, parameter.name) if several else (BulletSimulator, parameter.name)


@pytest.mark.parametrize(('factory', 'name'), list(tried_parameters()))
def test_every_parameter_changes_the_rollout(factory, name):
    # Internal damping that is less than the time step's own does nothing.
    value = 90.0 if name == 'internal_damping' else MIDDLE[name] + 20
    same = {name: MIDDLE[name]} if name in ('torsion', *BY_CLAMPS) else {}
    assert np.abs(chains_of(factory, **{name: value}) - chains_of(factory, **same)).max() > 1e-4


def test_a_held_end_stays_with_its_hand_and_a_released_one_does_not(make):
    engine = make(**SMALL)
    end = rollout(engine, fold_trial(held_by=('hand',))).chains[1, 14]
    assert end == pytest.approx((0.1, 0.04, 0.02), abs=1e-6)
    assert np.abs(rollout(engine).chains[1, 14] - end).max() > 1e-4


def test_a_hand_that_holds_stays_and_one_that_released_lets_the_point_sink(make):
    points = line((0, 0, 0.005), (1, 0, 0), 0.6, 21)
    hand = Hand('hand', (10,), [0.0, 1.0], [points[10], points[10] + (0, 0, 0.1)])
    for held_by, height in ((('hand',), 0.105), ((), 0.005)):
        trial = Trial('hold', Chain(points), (Action((hand,)),), (Goal(Chain(points), 2.0, held_by=held_by),))
        chain = make().simulate(trial, PHYSICAL).chains[0]
        assert chain[10, 2] == pytest.approx(height, abs=1e-3)


def test_a_clamp_keeps_the_direction_and_turns_with_the_hand(make):
    points = line((0, 0, 0.5), (1, 0, 0), 0.6, 21)
    turn = [[0, 0, 0, 1], [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]]  # a quarter about z
    hand = Hand('hand', (0, 1), [0.0, 1.0], [points[0], points[0]], turn)
    trial = Trial('turn', Chain(points), (Action((hand,)),), (Goal(Chain(points), 2.0, held_by=('hand',)),))
    chain = make(table=False).simulate(trial, PHYSICAL).chains[0]
    assert chain[1] == pytest.approx((0, 0.03, 0.5), abs=1e-4)


def test_timed_goals_see_the_chain_in_motion(make):
    points = line((0, 0, 1.0), (1, 0, 0), 0.6, 21)
    velocity = np.tile((0.0, 1.0, 0.0), (21, 1))
    hand = Hand('hand', (0,), [0.0, 0.2], [points[0], points[0] + (0, 0.2, 0)])
    goals = tuple(Goal(Chain(points), t, stable=False, held_by=('hand',)) for t in (0.05, 0.1033))
    trial = Trial('throw', Chain(points), (Action((hand,)),), goals, velocity)
    chains = make(table=False).simulate(trial, {**PHYSICAL, 'damping': 0.01}).chains
    for chain, t in zip(chains, (0.05, 0.1033), strict=True):
        # All of it moves at 1 m/s; the free end falls freely.
        assert chain[:, 1] == pytest.approx(np.full(21, t), abs=1e-3)
        assert chain[-1, 2] == pytest.approx(1.0 - GRAVITY * t**2 / 2, abs=3e-3)


def test_a_trial_that_never_settles_says_so(make):
    slow = make(table=False, settle_limit=0.5).simulate(drag_trial(), PHYSICAL)
    assert slow.settled == (False,)  # it falls for ever
    assert slow.chains[0, :, 2].max() < -0.5
    assert slow.duration < 3.0 + 0.5 + 0.05
    assert make().simulate(drag_trial(), PHYSICAL).settled == (True,)


def test_a_rollout_that_diverges_ends_as_a_simulation_error_and_the_next_one_is_whole(make):
    engine = make(**SMALL)
    whole = rollout(engine)
    with pytest.raises(SimulationError):
        engine.simulate(drag_trial(), {**PHYSICAL, 'flexibility': float('nan')})
    assert rollout(engine).chains.tobytes() == whole.chains.tobytes()


@each_engine('noise', [(0.001,)], [(0.0,)])
def test_a_radius_that_is_not_the_measured_height_neither_kicks_nor_floats(make, noise):
    simulator = make()
    trial = drag_trial(height=0.008, noise=noise)
    hand = Hand('hand', (5,), [0.0, 1.0], [trial.initial.points[5]] * 2)
    waiting = Trial('wait', trial.initial, (Action((hand,)),), trial.goals)
    dragged = []
    for radius in (0.002, 0.004, 0.008, 0.03):
        physical = {**PHYSICAL, 'self_collision': radius, 'friction': 1.0}
        chain = simulator.simulate(waiting, physical).chains[0]
        assert chain[:, 2] == pytest.approx(np.full(21, 0.008), abs=1e-3)
        assert np.abs(chain[:, :2] - trial.initial.points[:, :2]).max() < 0.001 + noise
        dragged.append(simulator.simulate(trial, physical).chains[0])
    for chain in dragged:
        assert np.abs(chain - dragged[2]).max() < 1e-9  # no part touches another: the radius changes nothing


def test_random_and_corner_parameter_sets_stay_finite(make):
    """Many of them, free parameters and the fixed ones, over a drag and a fold."""
    simulator = make(settle_limit=1.0)
    generator, count = np.random.default_rng(0), len(PARAMETERS)
    sets = np.concatenate([generator.integers(0, 2, (28, count)), generator.random((14, count))])
    if simulator.name == 'bullet':
        sets = sets[::5]  # the same internal forces, and far slower
    for k, point in enumerate(sets):
        trial = (drag_trial(noise=0.001), fold_trial())[k % 2]
        values = SPACE.values(point)
        if k % 4 < 2:  # what stores energy at the start throws a light DLO away; without it, it stays
            values.update(NEUTRAL)
        chains = simulator.simulate(trial, SPACE.physical(values, 0.6)).chains
        assert np.isfinite(chains).all()
        if k % 4 < 2:
            assert np.abs(chains).max() < 20.0, values  # a stiff one that was bent double flies


def test_options_reach_the_engine(make):
    longer = rollout(make(**SMALL, time_step=0.005))
    assert longer.duration == pytest.approx(longer.steps * 0.005)
    assert rollout(make(**{**SMALL, 'table_height': -1.0})).chains[-1, 1:14, 2].max() < -0.5
    loose = rollout(make(**SMALL, stable_distance=1.0))
    assert loose.steps < rollout(make(**SMALL)).steps
    assert rollout(make(**SMALL, stable_distance=1.0, stable_time=0.5)).steps > loose.steps
