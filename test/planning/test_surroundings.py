# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plans among bodies: ways of hands, sides of posts, detours, a clip, and what is refused."""

from dataclasses import replace

from made_up_dlo import arc, LENGTH, LEVEL, MadeUpDlo, straight
import numpy as np
import pytest

from dlo_calibration import Chain, InputError, Options
from dlo_calibration.planning import beam
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.planner import plan
from dlo_calibration.planning.surroundings import outline, passed_wrongly, Surroundings
from dlo_calibration.planning.ways import way_around
from dlo_calibration.simulation.scene import NO_TRIANGLES, Obstacle, read_scene

DLO = MadeUpDlo()
RADIUS, HEIGHT = 0.005, 0.05  # m of posts
CLEARANCE = 0.015  # m, the default
ONE = PlanOptions(workers=1, draws=2)
GOAL = arc(1.0)
BETWEEN = tuple((straight().points[14] + GOAL.points[14])[:2] / 2)  # a place that the DLO has to get around
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def post(x, y, radius=RADIUS, height=HEIGHT):
    """Return an upright cylinder on the table."""
    return Obstacle('cylinder', np.array([height, radius]), np.array([x, y, height / 2]), UPRIGHT, 1.0,
                    NO_TRIANGLES)


def box(sizes, position, turn=UPRIGHT):
    """Return a box."""
    return Obstacle('box', np.array(sizes), np.array(position), np.array(turn), 1.0, NO_TRIANGLES)


@pytest.fixture
def scene_of(tmp_path):
    """Return a function that writes upright cylinders and boxes to a scene, and returns its path."""
    def write(*obstacles):
        shapes = {'box': '<box size="{0} {1} {2}"/>', 'cylinder': '<cylinder length="{0}" radius="{1}"/>'}
        links = ''.join(
            f'<collision><origin xyz="{" ".join(map(str, each.position))}"/><geometry>'
            f'{shapes[each.shape].format(*each.sizes)}</geometry></collision>' for each in obstacles)
        path = tmp_path / 'scene.urdf'
        path.write_text(f'<robot name="scene"><link name="table">{links}</link></robot>')
        return str(path)
    return write


def ways(result):
    """Return places along the ways of all hands of a plan, (m, 3) [m], half a millimetre apart at most."""
    return np.concatenate([hand.positions_at(time) for action in result.actions for hand in
                           action.action.hands for time in np.arange(0, action.action.end, 0.005)])


def distances(places, centre, radius=RADIUS, height=HEIGHT):
    """Return the distances of places, (m, 3) [m], from an upright cylinder on the table, (m,) [m]."""
    aside = np.linalg.norm(places[:, :2] - centre, axis=1) - radius
    above = places[:, 2] - height
    return np.hypot(np.maximum(aside, 0), np.maximum(above, 0)) + np.minimum(np.maximum(aside, above), 0)


@pytest.mark.parametrize(('side', 'turn'), [(1, 0.0), (-1, 0.7), (1, 2.0)])
def test_a_way_keeps_the_clearance_and_passes_bodies_at_the_given_side(side, turn):
    obstacles = (post(0.2, 0.0), post(0.3, 0.01), box((0.02, 0.06, 0.1), (0.4, 0, 0.05), (
        0, 0, np.sin(turn / 2), np.cos(turn / 2))))
    around = Surroundings.of(obstacles, CLEARANCE)
    given = np.array([[0.0, 0.0], [0.2, 0.08 * side], [0.4, 0.08 * side], [0.6, 0.0]])
    way = way_around(around, given, LEVEL)
    np.testing.assert_array_equal(way[[0, -1]], given[[0, -1]])
    lengths = [np.linalg.norm(np.diff(each, axis=0), axis=1).sum() for each in (way, given)]
    assert lengths[0] < lengths[1]
    places = np.concatenate([begin + np.linspace(0, 1, 300)[:, None] * (end - begin)
                             for begin, end in zip(way, way[1:], strict=False)])
    assert (np.sign(places[np.abs(places[:, 0] - 0.3) < 0.1, 1]) == side).all()
    places = np.column_stack([places, np.full(len(places), LEVEL)])
    assert min(distances(places, (x, y)).min() for x, y in ((0.2, 0.0), (0.3, 0.01))) >= CLEARANCE - 1e-5
    cosine, sine = np.cos(turn), np.sin(turn)
    local = (places[:, :2] - (0.4, 0)) @ np.array([[cosine, -sine], [sine, cosine]])
    assert np.linalg.norm(np.maximum(np.abs(local) - (0.01, 0.03), 0), axis=1).min() >= CLEARANCE - 1e-5


@pytest.mark.long
def test_a_place_that_a_ring_of_bodies_encloses_has_no_way():
    ring = [post(0.1 * np.cos(angle), 0.1 * np.sin(angle)) for angle in np.linspace(0, 2 * np.pi, 24)]
    around = Surroundings.of(ring, CLEARANCE)
    out = np.array([[0.0, 0.0], [0.3, 0.0]])
    assert way_around(around, out, LEVEL) is None
    assert around.above(out, LEVEL) == pytest.approx(HEIGHT + CLEARANCE, abs=2e-3)


def test_the_outline_encloses_a_body_closely():
    turned = box((0.04, 0.02, 0.1), (1.0, 2.0, 0.05), (0, 0, np.sin(0.3), np.cos(0.3)))
    for obstacle, area in ((post(1, 2), np.pi * RADIUS**2), (turned, 0.04 * 0.02)):
        x, y = (outline(obstacle, 48) - (1, 2)).T
        found = np.abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        assert area <= found < 1.1 * area


def test_posts_between_two_chains_are_passed_at_another_side():
    start, goal = straight().points, straight().points + [0, 0.1, 0]
    posts = np.array([[0.3, 0.05], [0.3, 0.15], [0.3, -0.05], [0.7, 0.05], [0.1, 0.02]])
    assert [passed_wrongly(start, goal, one[None]) for one in posts] == [1, 0, 0, 0, 1]
    assert passed_wrongly(start, goal, posts) == 2
    around = 2 * np.pi * np.linspace(0, 2, 41)
    turns = np.column_stack([0.05 * np.cos(around), 0.05 * np.sin(around), np.zeros(41)])
    assert passed_wrongly(turns, turns[[0, -1]], np.zeros((1, 2))) == 2


@pytest.mark.long
def test_a_dlo_is_led_around_a_post_as_the_goal_lies(scene_of, monkeypatch):
    """
    The post stands between start and goal: of drags, only one that leads an end around it reaches the goal.

    Lifted, the DLO also gets over the post, but with more actions.
    """
    simulation, drags = Options(scene=scene_of(post(*BETWEEN))), replace(ONE, kinds=('drag',))
    led = plan(DLO, straight(), GOAL, drags, simulation=simulation)
    either = plan(DLO, straight(), GOAL, ONE, simulation=simulation)
    assert led.reached
    assert passed_wrongly(led.actions[-1].predicted, GOAL.points, np.array([BETWEEN])) == 0
    assert distances(ways(led), BETWEEN).min() >= CLEARANCE - 1e-5
    assert any(len(action.action.hands[0].positions) > 2 for action in led.actions)
    monkeypatch.setattr(beam, 'leading', lambda *_: [])
    carried = plan(DLO, straight(), GOAL, drags, simulation=simulation)
    assert not carried.reached
    assert len(plan(DLO, straight(), GOAL, ONE, simulation=simulation).actions) > len(either.actions)
    assert any('another side than in the goal' in warning for warning in carried.warnings)


@pytest.mark.long
def test_a_hand_goes_around_a_post_or_over_it_where_the_dlo_need_not(scene_of):
    """The post is beside the DLO, on the straight way of the gripped end."""
    goal = Chain(arc(0.8).points)
    place = tuple((straight().points[-1] + goal.points[-1])[:2] / 2 + [0.03, 0.0])
    for kinds in (('drag',), ('grasp_and_place',)):
        result = plan(DLO, straight(), goal, replace(ONE, kinds=kinds),
                      simulation=Options(scene=scene_of(post(*place))))
        assert result.reached
        assert distances(ways(result), place).min() >= CLEARANCE - 1e-5


@pytest.mark.long
def test_any_number_of_threads_finds_the_same_detour(scene_of):
    simulation = Options(scene=scene_of(post(*BETWEEN), post(0.3, -0.05)))
    single, double = (plan(DLO, straight(), GOAL, replace(ONE, workers=workers), simulation=simulation)
                      for workers in (1, 2))
    assert single.rollouts == double.rollouts
    for one, other in zip(single.actions, double.actions, strict=True):
        np.testing.assert_array_equal(one.action.hands[0].positions, other.action.hands[0].positions)
        np.testing.assert_array_equal(one.predicted, other.predicted)


@pytest.mark.long
def test_a_dlo_is_laid_into_a_clip_and_pulled_straight(scene_of):
    """Two posts 1.2 diameters of the DLO apart: no hand passes between them."""
    gap = 1.2 * 2 * LEVEL
    places = [(LENGTH / 2, side * (gap / 2 + RADIUS)) for side in (-1, 1)]
    start = Chain(straight().points + [0, 0.06, 0])
    result = plan(DLO, start, straight(), ONE,
                  simulation=Options(scene=scene_of(*(post(*place) for place in places))))
    assert result.reached
    end = result.actions[-1].predicted
    middle = end[8:13]
    assert np.abs(middle[:, 1]).max() < gap / 2 and middle[:, 2].max() < 2 * LEVEL
    assert min(distances(ways(result), place).min() for place in places) >= CLEARANCE - 1e-5


@pytest.mark.long
def test_hands_come_as_near_to_a_body_as_the_dlo_that_lies_on_it(scene_of):
    plate = box((2.0, 2.0, 0.1), (0.0, 0.0, -0.05))
    result = plan(DLO, straight(), GOAL, ONE, simulation=Options(scene=scene_of(plate), table=False))
    assert result.reached
    assert ways(result)[:, 2].min() > 0


def test_a_wall_that_no_hand_passes_is_named(scene_of):
    wall = box((0.01, 2.0, 2.0), (0.7, 0.0, 1.0))
    goal = Chain(straight().points + [0.8, 0, 0])
    options = replace(ONE, actions=1, kinds=('drag',), reach_1='box -1 -.5 0 2 .5 .5')
    result = plan(DLO, straight(), goal, options, simulation=Options(scene=scene_of(wall)))
    assert not result.reached
    assert any('reach' in warning for warning in result.warnings)


def test_a_goal_inside_a_body_is_refused(scene_of):
    with pytest.raises(InputError, match='inside a body of the scene'):
        plan(DLO, straight(), GOAL, ONE, simulation=Options(scene=scene_of(post(*GOAL.points[10, :2], 0.02))))


def test_a_mesh_that_is_not_closed_counts_as_its_box(tmp_path):
    (tmp_path / 'open.obj').write_text('v 0 0 0\nv 0.1 0 0\nv 0.1 0.2 0.3\nf 1 2 3\n')
    (tmp_path / 'open.urdf').write_text('<robot name="r"><link name="l"><collision><geometry><mesh '
                                        'filename="open.obj"/></geometry></collision></link></robot>')
    around = Surroundings.of(read_scene(str(tmp_path / 'open.urdf')), CLEARANCE)
    assert around.spare(np.array([0.05, -0.03, 0.1])) == pytest.approx(0.03 - CLEARANCE)
    assert around.cover(np.array([0.02, 0.1, 0.2]))
