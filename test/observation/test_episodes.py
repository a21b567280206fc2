# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Films are cut into episodes: where a hand holds the DLO, from when to when, and what is compared."""

from dataclasses import replace

from filmed_hands import CAMERA, CLOSES, COUNT, filmed_hand, OPENS, RADIUS
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_calibration.observation.episodes import Bounds, episodes
from dlo_calibration.observation.sightings import HandSightings, Sightings


def joined(*films):
    """Return the sightings of films one after the other."""
    seen = Sightings(np.concatenate([film[0].times for film in films]),
                     np.concatenate([film[0].points for film in films]),
                     np.concatenate([film[0].cameras for film in films]), RADIUS)
    hand = HandSightings('hand_1', np.concatenate([film[1].positions for film in films]),
                         np.concatenate([film[1].orientations for film in films]))
    return seen, hand


@pytest.mark.parametrize('place', [0.0, 0.3, 0.5, 0.98])
@pytest.mark.parametrize('way, turn', [((0.1, 0.12), 40.0), ((-0.08, 0.0), 0.0)])
def test_the_hand_and_the_held_point_are_found(place, way, turn):
    seen, hand, grip = filmed_hand(place, way=way, turn=turn)
    (episode,), problems = episodes(seen, [hand])
    assert not problems
    # Where the hand does not turn, hardly anything distinguishes the held point from its neighbours: the one
    # nearest to the tag counts, which is 29 mm, 5 % of the length, along the DLO.
    assert episode.places[0] == pytest.approx(place, abs=0.03 if turn else 0.055)
    path, = episode.hands
    assert CLOSES - 0.5 <= path.start <= CLOSES + 0.15
    assert OPENS - 0.1 <= path.end <= OPENS + 0.1
    truth = np.stack([np.interp(path.times, seen.times, axis) for axis in grip.T], axis=1)
    error = path.positions - truth
    assert np.linalg.norm(error - error.mean(axis=0), axis=1).max() < 0.01
    assert np.linalg.norm(error.mean(axis=0)) < 0.037


def test_a_tag_seen_from_straight_ahead_shows_how_far_the_hand_turns():
    # Its tilt across the line of sight is not seen well there.
    seen, hand, _ = filmed_hand(turn=-30.0)
    turned = Rotation.from_quat(hand.orientations)
    sight = CAMERA - hand.positions
    across = np.cross(sight, [1.0, 0.0, 0.0])
    ahead = np.clip(((CLOSES + OPENS) / 2 - seen.times) / 0.8, 0.0, 1.0)
    error = Rotation.from_rotvec(np.deg2rad(9.0 * ahead)[:, None]
                                 * across / np.linalg.norm(across, axis=1, keepdims=True))
    tilted = error * turned * Rotation.from_euler('x', -25.0, degrees=True)
    (episode,), _ = episodes(seen, [replace(hand, orientations=tilted.as_quat())])
    path, = episode.hands
    found = Rotation.from_quat(path.orientations)
    true = turned[np.searchsorted(seen.times, path.times)]
    away = (found * found[0].inv()) * (true * true[0].inv()).inv()
    assert np.rad2deg(away.magnitude()).max() < 1.0


def test_goals_show_the_moving_dlo_at_its_instants_and_then_its_rest():
    seen, hand, _ = filmed_hand()
    (episode,), _ = episodes(seen, [hand])
    times = np.array([time for time, _ in episode.goals])
    assert 8 <= episode.moving <= 20
    assert (times[:episode.moving] <= episode.hands[0].end).all()
    assert (times[episode.moving:] > episode.hands[0].end).all()
    assert (np.diff(times) > 0).all()
    initial = episode.initial.points
    assert np.abs(initial[:, 0] - 0.6 * np.linspace(0, 1, COUNT)).max() < 0.002
    assert episode.start < CLOSES < OPENS < episode.end


def test_parts_in_the_air_are_left_out():
    seen, hand, grip = filmed_hand(0.5, lift=0.06)
    (episode,), _ = episodes(seen, [hand])
    assert episode.places[0] == pytest.approx(0.5, abs=0.03)
    path, = episode.hands
    truth = np.stack([np.interp(path.times, seen.times, axis) for axis in grip.T], axis=1)
    assert np.abs(path.positions[:, 2] - truth[:, 2]).max() < 0.006
    high = [(time, points) for time, points in episode.goals[:episode.moving]
            if np.interp(time, path.times, path.positions[:, 2]) > RADIUS + 0.03]
    assert high
    for _, points in high:
        assert np.isnan(points[COUNT // 2 - 7:COUNT // 2 + 7]).all()
        assert np.isfinite(points[:5]).all()
    assert np.isfinite(episode.goals[-1][1]).any(axis=1).all()


def test_two_movements_make_two_episodes():
    first = filmed_hand(0.3)
    seen, hand = joined(first, filmed_hand(0.3, start=7.0, seed=1))
    cut, problems = episodes(seen, [hand])
    # The second film begins where the first one began, so that the DLO jumps between them.
    assert [episode.hands[0].name for episode in cut][:1] == ['hand_1']
    assert cut[-1].hands[0].start == pytest.approx(7.0 + CLOSES, abs=0.5)
    assert all('7.0' in problem or '6.9' in problem or '7.1' in problem for problem in problems)


@pytest.mark.long
def test_the_tag_is_where_it_was_when_the_hand_held_the_dlo_before():
    # The second movement is the same for all points nearby: alone, it leaves the place open.
    first = filmed_hand(0.3)
    seen, hand, grip = filmed_hand(0.95, turn=0.0, way=(-0.08, 0.0), start=7.0, seed=1)
    alone, = episodes(seen, [hand])[0]
    assert abs(alone.places[0] - 0.95) > 0.015
    moved = np.nanmedian(first[0].points[-20:], axis=0) - np.nanmedian(seen.points[:20], axis=0)
    second = (replace(seen, points=seen.points + moved),
              replace(hand, positions=hand.positions + moved[round(0.95 * (COUNT - 1))]), grip)
    cut, _ = episodes(*[part if k == 0 else [part] for k, part in enumerate(joined(first, second))])
    assert [episode.places[0] for episode in cut] == [
        pytest.approx(0.3, abs=0.006), pytest.approx(0.95, abs=0.011)]


def shown(seen, hand, rows, points=None):
    """Return sightings of the pictures `rows` one after the other, and other points if given."""
    return (Sightings(np.arange(len(rows)) / 30.0, seen.points[rows] if points is None else points,
                      seen.cameras[rows], RADIUS),
            replace(hand, positions=hand.positions[rows], orientations=hand.orientations[rows]))


def test_a_hand_that_pauses_on_its_way_holds_the_dlo():
    seen, hand, _ = filmed_hand()
    halfway = int(np.searchsorted(seen.times, (CLOSES + OPENS) / 2))
    seen, hand = shown(seen, hand, np.r_[:halfway, [halfway] * 12, halfway:len(seen.times)])
    (episode,), problems = episodes(seen, [hand])
    assert not problems
    assert episode.hands[0].end == pytest.approx(OPENS + 12 / 30, abs=0.1)


def test_a_hand_whose_tag_is_not_seen_as_it_closes_has_closed_when_the_dlo_begins_to_move():
    seen, hand, grip = filmed_hand()
    hidden = (seen.times > CLOSES - 0.5) & (seen.times < CLOSES + 0.4)
    positions = np.where(hidden[:, None], np.nan, hand.positions)
    (episode,), problems = episodes(seen, [replace(hand, positions=positions)])
    assert not problems
    path, = episode.hands
    assert path.start == pytest.approx(CLOSES, abs=0.2)
    truth = np.stack([np.interp(path.times, seen.times, axis) for axis in grip.T], axis=1)
    assert np.linalg.norm(path.positions - truth, axis=1).max() < 0.01


def test_a_hand_that_goes_on_without_the_dlo_has_opened():
    seen, hand, _ = filmed_hand()
    drops = int(np.searchsorted(seen.times, (CLOSES + OPENS) / 2))
    rows = np.arange(len(seen.times))
    seen, hand = shown(seen, hand, rows, seen.points[np.minimum(rows, drops)])
    (episode,), problems = episodes(seen, [hand])
    assert not problems
    assert episode.hands[0].end == pytest.approx(seen.times[drops], abs=0.15)


def test_two_hands_share_an_episode():
    seen, one, _ = filmed_hand(0.15, seed=2)
    other_seen, other, _ = filmed_hand(0.85, way=(-0.05, 0.1), seed=3)
    rest = filmed_hand(0.15, way=(0.0, 0.0), noise=0.0)[0].points
    both = np.where(np.linspace(0, 1, COUNT)[None, :, None] < 0.5, seen.points, other_seen.points)
    assert rest.shape == both.shape
    cut, problems = episodes(replace(seen, points=both), [one, replace(other, name='hand_2')])
    assert not problems
    assert len(cut) == 1
    assert cut[0].places == pytest.approx((0.15, 0.85), abs=0.04)


def test_a_tag_that_passes_by_holds_nothing():
    seen, hand, _ = filmed_hand(0.3)
    bystander = filmed_hand(0.9, way=(-0.2, 0.05), seed=4)[1]
    (episode,), _ = episodes(seen, [replace(bystander, name='hand_2'), hand])
    assert [path.name for path in episode.hands] == ['hand_1']


def test_a_person_may_say_which_point_is_held():
    seen, _, grip = filmed_hand(0.5, hidden=0)
    points = seen.points[:, COUNT // 2]
    rows = np.arange(len(points))
    known = np.isfinite(points[:, 0])
    path = np.stack([np.interp(rows, rows[known], axis[known]) for axis in points.T], axis=1)
    (episode,), problems = episodes(seen, [HandSightings('hand_1', path, place=0.5)])
    assert not problems
    assert episode.places == (0.5,)
    assert episode.hands[0].start == pytest.approx(CLOSES, abs=0.25)
    assert episode.hands[0].end == pytest.approx(OPENS, abs=0.25)


def test_a_movement_without_a_hand_says_what_to_do():
    seen, _, _ = filmed_hand()
    cut, problems = episodes(seen, [])
    assert not cut
    assert len(problems) == 1
    assert 'no tag in the film' in problems[0]
    assert '--held' in problems[0]


def test_a_dlo_at_rest_makes_no_episode():
    seen, hand, _ = filmed_hand(way=(0.0, 0.0))
    assert episodes(seen, [hand]) == ((), ())


def test_a_film_without_a_rest_says_what_to_do():
    seen, hand, _ = filmed_hand()
    moves = (seen.times > CLOSES + 0.2) & (seen.times < OPENS - 0.2)
    seen = replace(seen, times=seen.times[moves], points=seen.points[moves], cameras=seen.cameras[moves])
    hand = replace(hand, positions=hand.positions[moves], orientations=hand.orientations[moves])
    cut, (problem,) = episodes(seen, [hand])
    assert not cut
    assert 'rest' in problem and 'begin to film earlier' in problem


@pytest.fixture(scope='module')
def two_movements():
    """Give the sightings of two movements of 7 s each, between which the DLO jumps back, and the episodes."""
    seen, hand = joined(filmed_hand()[:2], filmed_hand(start=7.0, seed=1)[:2])
    found, _ = episodes(seen, [hand])
    assert len(found) == 2
    return seen, hand, found


def middle(episode):
    return (episode.hands[0].start + episode.hands[0].end) / 2


def test_bounds_as_they_were_found_change_nothing(two_movements):
    seen, hand, found = two_movements
    again, _ = episodes(seen, [hand], None, [Bounds(middle(own), own.start, own.end) for own in found])
    for own, other in zip(found, again, strict=True):
        assert np.array_equal(own.initial.points, other.initial.points)
        assert [time for time, _ in own.goals] == [time for time, _ in other.goals]
        assert np.array_equal(own.hands[0].positions, other.hands[0].positions)


def test_an_episode_begins_and_ends_where_a_person_wants_it(two_movements):
    seen, hand, (first, second) = two_movements
    (own, other), _ = episodes(seen, [hand], None, [Bounds(middle(first), 1.0, 4.6)])
    assert own.start == pytest.approx(1.0, abs=0.05) and own.end == pytest.approx(4.6, abs=0.05)
    assert max(time for time, _ in own.goals) <= 4.6
    assert own.places[0] == pytest.approx(first.places[0], abs=0.02)
    assert (other.start, other.end) == (second.start, second.end)


def test_an_episode_ends_before_the_next_movement_begins(two_movements):
    seen, hand, (first, second) = two_movements
    (own, _), _ = episodes(seen, [hand], None, [Bounds(middle(first), None, second.end)])
    assert first.end <= own.end < second.hands[0].start


def test_bounds_leave_a_little_of_each_rest(two_movements):
    seen, hand, (first, second) = two_movements
    closes, opens = first.hands[0].start, first.hands[0].end
    (own, _), _ = episodes(seen, [hand], None, [Bounds(middle(first), opens, closes)])
    assert own.start == pytest.approx(first.latest_start, abs=0.05) and own.start < closes
    assert own.end == pytest.approx(first.earliest_end, abs=0.05) and own.end > opens
    assert own.moving == first.moving


def test_bounds_of_a_movement_that_is_not_there_are_without_effect(two_movements):
    seen, hand, found = two_movements
    again, _ = episodes(seen, [hand], None, [Bounds(6.0, 5.5, 6.5)])
    assert [(own.start, own.end) for own in again] == [(own.start, own.end) for own in found]
