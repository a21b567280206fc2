# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a DLO bears on its way, where the sharpest bend, the tension and the strain are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation import core
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.loads import CURVATURE, STRAIN, TENSION
from dlo_calibration.simulation.protocol import Stop
from dlo_calibration.simulation.scene import NO_TRIANGLES, Obstacle

LENGTH, MASS, LEVEL = 0.6, 0.03, 0.004
ROPE = {'flexibility': 1e-4, 'elasticity': 300.0, 'friction': 0.5, 'self_collision': LEVEL, 'mass': MASS,
        'damping': 0.1, 'internal_damping': 1e-3}
ALONG = np.linspace(0, LENGTH, 31)
LYING = np.column_stack([ALONG, 0 * ALONG, np.full(31, LEVEL)])
HANGING = np.column_stack([0 * ALONG, 0 * ALONG, -ALONG])
TAUT = np.column_stack([ALONG, 0 * ALONG, 0 * ALONG])


@pytest.fixture(params=(CompiledSimulator, BulletSimulator), ids=lambda engine: engine.name)
def make(request):
    """Give a function that makes simulators of one engine, which are closed at the end."""
    made = []

    def make(**settings):
        made.append(request.param(**{'nodes': 31, **settings}))
        return made[-1]

    yield make
    for simulator in made:
        simulator.close()


def moved(points, *paths, times=(0.0, 1.0), goals=None):
    """
    Return a trial in which hands move points, and hold them afterwards.

    :param paths: of each hand, the point and its ways from there [m], one for each of the later times.
    """
    hands = tuple(Hand(f'hand {k}', (point,), times, points[point] + np.array([(0, 0, 0), *ways], float))
                  for k, (point, *ways) in enumerate(paths))
    names, chain = tuple(hand.name for hand in hands), Chain(points)
    return Trial('moved', chain, (Action(hands),), goals or (Goal(chain, times[-1] + 0.01, held_by=names),),
                 loads=True)


def loads_of(simulator, trial, **physical):
    """Return the largest loads in a trial, (3,), and where, (3,) [m]."""
    loads = simulator.simulate(trial, {**ROPE, **physical}).loads.over([slice(None)])
    return loads.most[0], loads.places[0]


@pytest.mark.parametrize('elasticity', [300.0, 1e4])
def test_the_tension_of_a_hanging_rope_is_the_weight_below(make, elasticity):
    trial = moved(HANGING, (0, (0, 0, 0)))
    most, places = loads_of(make(table=False), trial, elasticity=elasticity)
    assert most[TENSION] == pytest.approx(MASS * GRAVITY, rel=0.02)
    assert most[STRAIN] == pytest.approx(MASS * GRAVITY / elasticity * (1 - 1 / 60), rel=0.02)
    assert places[TENSION] == 0.0
    assert places[STRAIN] == pytest.approx(0.01)  # in the middle of the first of 30 segments


def test_where_a_rope_hangs_from_its_middle_each_half_bears_its_own_weight(make):
    folded = np.column_stack([0.01 * np.tanh((ALONG - 0.3) / 0.01), 0 * ALONG, -np.abs(ALONG - 0.3)])
    goals = [Goal(Chain(folded), time, False, ('hand 0',)) for time in (4.0, 5.0)]
    trial = moved(folded, (15, (0, 0, 0)), times=(0.0, 5.0), goals=goals)
    physical = {**ROPE, 'flexibility': 1e-6, 'damping': 10.0, 'self_collision': 5e-4}
    loads = make(table=False).simulate(trial, physical).loads
    np.testing.assert_allclose(loads.most[-1, TENSION], MASS * GRAVITY / 2, rtol=0.02)
    np.testing.assert_allclose(loads.places[-1, TENSION], LENGTH / 2, atol=5e-3)


def test_a_heavier_end_is_borne_too(make):
    trial = moved(HANGING, (0, (0, 0, 0)))
    trial = replace(trial, initial=replace(trial.initial, features=np.arange(31) == 30))
    most, _ = loads_of(make(table=False), trial, marker_mass=0.02)
    assert most[TENSION] == pytest.approx((MASS + 0.02) * GRAVITY, rel=0.02)


@pytest.mark.parametrize(('elasticity', 'internal_damping'), [
    (30.0, 1e-3), (30.0, 1e-2), (300.0, 1e-3), (300.0, 1e-2), (1e4, 1e-3)])
def test_a_rope_that_is_pulled_over_a_table_bears_its_friction(make, elasticity, internal_damping):
    trial = moved(LYING, (0, (-0.05, 0, 0)))
    if elasticity < 100:  # so soft that it begins to slide only after 6 mm
        trial = moved(LYING, (0, (-0.15, 0, 0)), times=(0.0, 3.0))
    most, places = loads_of(make(), trial, elasticity=elasticity, internal_damping=internal_damping)
    assert most[TENSION] == pytest.approx(ROPE['friction'] * MASS * GRAVITY, rel=0.08)
    assert places[TENSION] <= 0.01  # at the hand
    assert most[CURVATURE] < 0.5


@pytest.mark.parametrize('strain', [0.002, 0.01])
def test_a_rope_that_two_hands_stretch_bears_ea_times_the_strain(make, strain):
    trial = moved(TAUT, (0, (0, 0, 0), (0, 0, 0)), (30, (strain * LENGTH, 0, 0), (strain * LENGTH, 0, 0)),
                  times=(0.0, 1.0, 1.5))
    most, _ = loads_of(make(table=False), trial, mass=1e-4, elasticity=1000.0)
    assert most[STRAIN] == pytest.approx(strain, rel=0.01)
    assert most[TENSION] == pytest.approx(1000.0 * strain, rel=0.01)


def test_hands_that_open_as_soon_as_the_rope_is_taut_have_pulled_nearly_as_hard(make):
    trial = moved(TAUT, (0, (0, 0, 0)), (30, (0.01 * LENGTH, 0, 0)), times=(0.0, 1.0))
    trial = replace(trial, goals=(replace(trial.goals[0], held_by=()),))
    most, _ = loads_of(make(), trial, elasticity=1000.0)
    assert most[TENSION] == pytest.approx(10.0, rel=0.05)


def test_a_hand_that_starts_at_once_is_no_shock(make):
    """Unsmoothed, that of a stiff rope at 0.2 m/s would be 4 N."""
    trial = moved(LYING, (0, (-0.1, 0, 0)), times=(0.0, 0.5))
    most, _ = loads_of(make(), trial, elasticity=1e4)
    assert most[TENSION] < 2 * ROPE['friction'] * MASS * GRAVITY


def circle(radius, length=LENGTH, points=31):
    """Return an arc of a circle that lies on the table."""
    angle = np.linspace(0, length / radius, points)
    return radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) + (0, 0, LEVEL)


@pytest.mark.parametrize('radius', [0.1, 0.3])
def test_the_bend_of_a_circle_has_its_radius(make, radius):
    """The rope is so limp that friction keeps it where it lies."""
    trial = moved(circle(radius), (0, (0, 0, 0)), times=(0.0, 0.05))
    most, _ = loads_of(make(), trial, flexibility=1e-6)
    assert 1 / most[CURVATURE] == pytest.approx(radius, rel=0.05)


@pytest.mark.parametrize('nearer', [0.1, 0.4])
def test_a_rod_between_two_pins_bends_as_the_elastica(nearer):
    """
    The pins come nearer to each other by a share of the length; there is no gravity.

    For the modulus k, their distance is L (2 E / K - 1), and the curvature in the middle 4 k K / L (Love, A
    Treatise on the Mathematical Theory of Elasticity, 1927, section 263).
    """
    count, step = 41, 0.003
    square = brentq(lambda m: 2 * ellipe(m) / ellipk(m) - 1 - (1 - nearer), 1e-6, 0.99)
    places = np.linspace(0, LENGTH, count)
    points = np.column_stack([places, 1e-3 * np.sin(np.pi * places / LENGTH), 0 * places])
    physical = {**ROPE, 'flexibility': 1e-2, 'elasticity': 1e4, 'damping': 3.0, 'internal_damping': 0.02}
    rope = core.Rope(core.Start(places, points, 0 * points), physical, step, -1e6, np.zeros(3))
    steps = np.minimum(np.arange(1, 2001) / 1000, 1.0)
    ways = np.column_stack([LENGTH * (1 - nearer * steps), 0 * steps, 0 * steps])
    turns = np.tile(np.eye(3).ravel(), (len(steps), 1))
    grips = [core.Grip([0], 0 * ways, None, turns), core.Grip([1], ways, None, turns)]
    event = core.Event
    script = core.Script([
        event.close(0, [0], points[0]), event.close(1, [count - 1], points[-1]), event.hold([0, count - 1]),
        event.advance(grips, 2000), event.advance(grips, 4000, settles=True), event.see(), event.see()],
        1e-5, 100, True)
    outcome = rope.follow(script, rope.step)
    assert outcome is not None and outcome[1] == (True, True)
    moving, (curvature, place) = outcome[3][:, CURVATURE]
    assert moving[0] >= curvature
    assert curvature == pytest.approx(4 * np.sqrt(square) * ellipk(square) / LENGTH, rel=0.01)
    assert place == pytest.approx((count - 1) / 2, abs=2)


def test_a_clamp_bends_the_rod_where_it_leaves_the_clamp(make):
    """A stiff cantilever: the moment at the clamp is half its weight times its length."""
    points = np.column_stack([ALONG, 0 * ALONG, 0 * ALONG])
    hand = Hand('hand', (0, 1), [0.0, 0.1], [points[0]] * 2)
    trial = Trial('held', Chain(points), (Action((hand,)),), (Goal(Chain(points), 0.2, held_by=('hand',)),),
                  loads=True)
    stiffness, free = 0.5, LENGTH - 0.02
    most, places = loads_of(make(table=False), trial, flexibility=stiffness, damping=20.0, elasticity=1e4,
                            internal_damping=0.1)
    assert most[CURVATURE] == pytest.approx(MASS / LENGTH * GRAVITY * free**2 / 2 / stiffness, rel=0.1)
    assert places[CURVATURE] == pytest.approx(0.02)


@pytest.mark.parametrize('angle', [np.pi / 2, np.pi])
def test_around_a_peg_the_tension_grows_as_the_capstan_equation_says(angle):
    """A hand slowly pulls a light rope over a cylinder; a weight hangs from its other end."""
    weight, radius, friction, leg = 0.1, 0.03, 0.2, 0.15
    turn, count = radius + ROPE['self_collision'], 61
    along = np.linspace(0, 2 * leg + angle * turn, count)
    arc = np.clip((along - leg) / turn, 0, angle)
    points = turn * np.column_stack([-np.cos(arc), 0 * arc, np.sin(arc)])
    points[:, 2] -= np.maximum(leg - along, 0)
    way = np.array([np.sin(angle), 0, np.cos(angle)])
    points += np.maximum(along - leg - angle * turn, 0)[:, None] * way
    hand = Hand('hand', (count - 1,), [0.0, 2.0], [points[-1], points[-1] + 0.06 * way])
    goals = [Goal(Chain(points), time, False, ('hand',)) for time in (1.0, 1.9)]
    chain = Chain(points, features=np.arange(count) == 0)
    trial = Trial('pulled', chain, (Action((hand,)),), goals, loads=True)
    along_y = np.array([0.5**0.5, 0, 0, 0.5**0.5])
    peg = Obstacle('cylinder', np.array([2.0, radius]), np.zeros(3), along_y, 1.0, NO_TRIANGLES)
    simulator = CompiledSimulator(nodes=count, table=False, obstacles=[peg])
    loads = simulator.simulate(trial, {**ROPE, 'flexibility': 1e-6, 'elasticity': 2000.0, 'mass': 1e-3,
                                       'friction': friction, 'marker_mass': weight, 'damping': 1e-3}).loads
    expected = weight * GRAVITY * np.exp(friction * angle)
    # A light rope that sticks and slips: starts that differ by 1 um or less change it by 1.5 %.
    assert loads.most[-1, TENSION] == pytest.approx(expected, rel=0.06)
    assert loads.places[-1, TENSION] > leg + angle * turn - 0.06  # beyond the peg


def test_what_a_goal_shows_is_since_the_goal_before(make):
    """A rope that is carried up by its middle, and put down again, with goals on the way."""
    points, names = LYING, ('hand 0',)
    times = (0.0, 1.0, 2.0)
    stops = (Goal(Chain(points), 0.0005, False, names), Goal(Chain(points), 1.0, False, names),
             Goal(Chain(points), 1.5, False, names), Goal(Chain(points), 2.01))
    path = (15, (0, 0, 0.1), (0, 0, 0.0))
    simulator = make()
    apart = simulator.simulate(moved(points, path, times=times, goals=stops), ROPE).loads
    whole = simulator.simulate(moved(points, path, times=times, goals=stops[-1:]), ROPE).loads
    assert apart.most.shape == apart.places.shape == (4, 3)
    np.testing.assert_array_equal(apart.over([slice(None)]).most, whole.most)
    np.testing.assert_array_equal(apart.over([slice(None)]).places, whole.places)
    assert apart.most[0, TENSION] < 0.2 * apart.most[1, TENSION]
    np.testing.assert_allclose(apart.places[1:3, TENSION], 0.3, atol=0.06)


def test_measuring_changes_nothing_and_does_not_depend_on_what_is_simulated_beside():
    simulator = CompiledSimulator(nodes=31)
    trials = [moved(LYING, (point, (0, 0.05, 0.05), (0, 0.1, 0)), times=(0.0, 0.5, 1.0))
              for point in (0, 7, 15, 30)]
    jobs = [(trial, {**ROPE, 'elasticity': 100.0 * k}) for k, trial in enumerate(trials, 1)]
    silent = [(replace(trial, loads=False), physical) for trial, physical in jobs]
    together = simulator.simulate_together([*jobs, *silent, *jobs], Stop())
    for k, ((trial, physical), (quiet, _)) in enumerate(zip(jobs, silent, strict=True)):
        alone, without = simulator.simulate(trial, physical), simulator.simulate(quiet, physical)
        assert without.loads is None and together[4 + k].loads is None
        assert alone.chains.tobytes() == without.chains.tobytes() == together[k].chains.tobytes()
        for other in (together[k], together[8 + k]):
            assert other.loads.most.tobytes() == alone.loads.most.tobytes()
            assert other.loads.places.tobytes() == alone.loads.places.tobytes()


def test_both_engines_measure_alike():
    trial = moved(LYING, (7, (0, 0.05, 0.05), (0, 0.1, 0)), times=(0.0, 0.5, 1.0))
    loads = [loads_of(engine(nodes=31), trial) for engine in (CompiledSimulator, BulletSimulator)]
    np.testing.assert_allclose(loads[0][0], loads[1][0], rtol=0.02)
    np.testing.assert_allclose(loads[0][1], loads[1][1], atol=0.02)
