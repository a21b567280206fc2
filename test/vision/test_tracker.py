# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The tracker follows a DLO in small rendered films, whose truth is known, and says what it does not see."""

from dataclasses import replace
import functools
import math

import cv2
from films import Instant, plain_look, Renderer
from laid_board import LaidBoard
import numpy as np
from photographs import Camera, Hand
import pytest

from dlo_calibration.vision.board import BOTTOM, COLUMNS, PAPERS, SQUARE
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.observer import Observer
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracker import Tracker
from dlo_calibration.vision.view import BoardFinder

LENGTH, RADIUS = 0.5, 0.005  # m
COUNT = 21
CAMERA = Camera((640, 480), 620.0, 0.3, 0.1, 0.0, 0.8, (0.25, 0.0))
STEP = 1 / 30  # s
FAR = 0.004  # m: half a diameter is 5 mm
BESIDE = LaidBoard((0.3, -0.45), 0.1)


@functools.cache
def renderer():
    return Renderer(plain_look(), RADIUS, (-0.3, -0.5), (0.8, 0.5))


def bent(amount, shift=(0.0, 0.0)):
    """Return a DLO (n, 3) [m] of the same length whose curvature grows with the amount."""
    arc = np.linspace(0.0, LENGTH, 401)
    angle = amount * np.sin(2 * np.pi * arc / LENGTH)
    steps = np.column_stack([np.cos(angle), np.sin(angle)]) * LENGTH / 400
    flat = np.concatenate([[[0.0, 0.0]], np.cumsum(steps[:-1], axis=0)]) + shift
    return np.column_stack([flat, np.full(len(flat), RADIUS)])


def points_of(curve):
    """Return the points (COUNT, 3) that the tracker should find."""
    return curve[np.linspace(0, len(curve) - 1, COUNT).round().astype(int)]


def scale_of(camera):
    lens = Lens(camera.size, camera.matrix, np.zeros(4))
    return Scale(lens, camera.rotation, -camera.rotation @ camera.position, np.zeros(1), True)


def tracked(curves, hands=None, camera=CAMERA, drawn=None, scaled=True, seed=0):
    """Return what is tracked in the images of curves."""
    tracker, listed = Tracker(COUNT), []
    scale = scale_of(camera) if scaled else None
    drawn = drawn or (lambda pixels, k: pixels)
    renderer().restart(seed)
    for k, curve in enumerate(curves):
        pixels = drawn(renderer().image([Instant(camera, curve, hands[k] if hands else ())]), k)
        if k == 0:
            clicks = camera.project(points_of(curve)[::5]) + 2.0
            listed.append(tracker.start(pixels, clicks, scale))
        else:
            listed.append(tracker.next(pixels, STEP, scale))
    return listed


def errors(found, curve, camera=CAMERA):
    """Return the distance (COUNT,) on the table of each tracked point from where it is [m]."""
    points = scale_of(camera).points(found.pixels, RADIUS)
    return np.linalg.norm((points - points_of(curve))[:, :2], axis=1)


def moving(count):
    """Return curves that bend, and move across at 0.4 m/s."""
    return [bent(0.3 + 0.5 * k / count, (0.0, 0.4 * STEP * k)) for k in range(count)]


@pytest.mark.long
@pytest.mark.parametrize('scaled', [True, False])
def test_points_stay_on_their_material(scaled):
    curves = moving(10)
    found = tracked(curves, scaled=scaled)
    for one, curve in zip(found, curves, strict=True):
        assert not one.lost
        off = errors(one, curve)
        assert np.isfinite(off[1:-1]).all()
        # Without a scale, perspective makes parts that are nearer longer.
        assert np.nanmean(off) < (0.0015 if scaled else 0.008)
        assert np.nanmax(off) < (FAR if scaled else 0.02)
    wide = 2 * RADIUS * CAMERA.focal_length / CAMERA.distance
    assert found[-1].width == pytest.approx(wide, rel=0.3)


@pytest.mark.long
def test_time_can_run_backwards():
    curves = moving(10)[::-1]
    assert np.nanmax(errors(tracked(curves)[-1], curves[-1])) < FAR


@pytest.mark.long
def test_what_a_hand_hides_is_not_a_number_and_the_rest_is_right():
    curves = [bent(0.5)] * 10
    hands = [(Hand((0.25, -0.13 + 0.03 * k)),) for k in range(10)]
    found = tracked(curves, hands)
    off = errors(found[-1], curves[0])
    assert np.isnan(off[8:13]).any()
    assert np.isfinite(off[1:6]).all() and np.isfinite(off[16:-1]).all()
    assert np.nanmax(off) < FAR


def test_a_hidden_end_does_not_shift_the_points():
    curves = [bent(0.3)] * 10
    hands = [(Hand((0.49, -0.14 + 0.016 * k), -1.2),) for k in range(10)]
    found = tracked(curves, hands)
    off = errors(found[-1], curves[0])
    assert np.isnan(off[-1])
    assert np.nanmax(off) < FAR


@pytest.mark.long
def test_paper_that_lay_on_the_table_from_the_beginning_does_not_cover_an_end_before_it():
    corners = CAMERA.project([[x, y, 0.0] for x, y in ((0.512, -0.1), (0.6, -0.1), (0.6, 0.1), (0.512, 0.1))])

    def with_paper(pixels, _):
        return cv2.fillConvexPoly(pixels.copy(), np.rint(corners).astype(np.int32), (235, 235, 230))

    # The hand pushes the DLO towards the paper; it covers the other end.
    curves = [bent(0.2, (0.001 * min(max(k - 4, 0), 12), 0.0)) for k in range(16)]
    hands = [()] * 3 + [(Hand((curve[0, 0] + 0.01, curve[0, 1])),) for curve in curves[3:]]
    assert np.nanmax(errors(tracked(curves, hands, drawn=with_paper)[-1], curves[-1])) < FAR


@pytest.mark.long
def test_where_a_hand_covers_an_end_is_no_end_though_the_other_end_is_hidden():
    def drawn(pixels, k):
        edges = ((-0.05, 0.005 * max(k - 4, 0)), (0.35, 0.55)) if k else ()
        for begin, end in edges:
            corners = np.array([[begin, -0.2, 0.0], [end, -0.2, 0.0], [end, 0.2, 0.0], [begin, 0.2, 0.0]])
            cv2.fillPoly(pixels, [np.rint(CAMERA.project(corners)).astype(np.int32)], (190, 140, 110))
        return pixels

    curve = bent(0.3)
    for one in tracked([curve] * 20, drawn=drawn):
        assert not one.lost
        assert np.nanmax(errors(one, curve)) < FAR


def lifted(height, at):
    """Return a DLO (n, 3) [m] that is held so high [m] at a fraction; both ends slide towards it."""
    ends = -at * LENGTH, (1 - at) * LENGTH
    place = np.linspace(-LENGTH, LENGTH, 4001)
    rise = height * np.square(np.maximum(1.0 - np.square(place / (0.72 * at * LENGTH)), 0.0))
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(place), np.diff(rise)))])
    arc -= arc[2000]
    even = np.linspace(*ends, 401)
    return np.column_stack([np.interp(even, arc, place) - ends[0], np.zeros(401),
                            np.interp(even, arc, rise) + RADIUS])


@pytest.mark.long
@pytest.mark.parametrize(('at', 'most'), [(0.5, 0.1), (0.3, 0.08)])
def test_what_stays_on_the_table_is_right_while_a_part_between_the_ends_is_lifted(at, most):
    heights = np.concatenate([np.zeros(4), np.linspace(0.0, most, 20), np.full(2, most)])
    curves = [lifted(height, at) for height in heights]
    hands = [(Hand((at * LENGTH, 0.01), -1.5, float(height) + RADIUS),) for height in heights]
    found = tracked(curves, hands)
    for one, curve in zip(found, curves, strict=True):
        on_table = points_of(curve)[:, 2] < RADIUS + 0.001
        off = errors(one, curve)[on_table]
        assert np.isfinite(off).sum() >= 2  # an end itself is hardly ever seen
        assert np.nanmax(off) < FAR


def turned(angle):
    """Return a DLO (n, 3) [m] whose last part is turned [rad]."""
    arc = np.linspace(0.0, LENGTH, 401)
    heading = angle / (1.0 + np.exp(-(arc - 0.6 * LENGTH) / 0.02))
    steps = np.column_stack([np.cos(heading), np.sin(heading)]) * LENGTH / 400
    flat = np.concatenate([[[0.0, 0.0]], np.cumsum(steps[:-1], axis=0)])
    return np.column_stack([flat, np.full(len(flat), RADIUS)])


@pytest.mark.long
def test_a_line_goes_on_where_its_rest_comes_out_of_what_hides_it():
    curves = [turned(0.0)] * 4 + [turned(0.16 * k) for k in range(6)] + [turned(0.8)] * 4

    def drawn(pixels, k):
        begin, end = 0.24, (0.0, 0.55, 0.35)[(k >= 3) + (k >= 10)]
        corners = np.array([[begin, -0.2, 0.0], [end, -0.2, 0.0], [end, 0.25, 0.0], [begin, 0.25, 0.0]])
        covered = np.rint(CAMERA.project(corners)).astype(np.int32)
        return cv2.fillPoly(pixels.copy(), [covered], (190, 140, 110)) if end else pixels

    found = tracked(curves, drawn=drawn)
    for one, curve in zip(found[:10], curves, strict=False):
        assert not one.lost
        assert np.nanmax(errors(one, curve)[:9]) < FAR
    # Not at its first sight, but before the whole picture is searched.
    for one, curve in zip(found[12:], curves[12:], strict=True):
        off = errors(one, curve)
        assert np.isfinite(off[-4:-1]).all()
        assert np.nanmax(off) < FAR


def test_a_crossing_keeps_the_order():
    arc = np.linspace(0.0, LENGTH, 401)
    curves = []
    for k in range(16):
        # A loop in the middle that slides along.
        bump = np.exp(-(((arc - 0.2 - 0.004 * k) / 0.085) ** 4))
        angle = 5.2 * np.cumsum(bump) / bump.sum() - 2.6
        flat = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]), axis=0) * LENGTH / 400
        flat += (0.25, 0.05) - flat[200]
        height = RADIUS + 2 * RADIUS * np.exp(-(((arc - arc[-1]) / 0.2) ** 2))
        curves.append(np.column_stack([flat, height]))
    found = tracked(curves)
    for one, curve in zip(found, curves, strict=True):
        assert not one.lost
        on_table = curve[np.linspace(0, 400, COUNT).round().astype(int), 2] < RADIUS + 0.001
        off = errors(one, curve)[on_table]
        # The loop slides, and the points with it; on the wrong strand they would be 0.1 m and more away.
        assert np.nanmax(off) < 0.03
        assert np.isfinite(off).mean() > 0.7


@pytest.mark.long
def test_a_dlo_that_leaves_the_picture_and_comes_back():
    ways = np.concatenate([np.arange(0, 18), np.arange(18, -1, -1)]) * 0.012
    curves = [bent(0.3, (0.1 + way, 0.0)) for way in ways]
    found = tracked(curves)
    outside = found[18]
    true = CAMERA.project(points_of(curves[18]))
    gone = true[:, 0] > CAMERA.size[0]
    assert gone.any()
    assert np.isnan(outside.pixels[gone]).all()
    assert np.nanmax(errors(outside, curves[18])) < 2 * FAR
    assert np.nanmax(errors(found[-1], curves[-1])) < FAR


def test_a_line_that_has_come_off_the_end_finds_back():
    curve = bent(0.4)
    pixels, scale = renderer().image([Instant(CAMERA, curve)]), scale_of(CAMERA)
    tracker = Tracker(COUNT)
    tracker.start(pixels, CAMERA.project(points_of(curve)[::5]), scale)
    line = np.array(tracker._line.line)
    line[-9:] = line[-9] + (line[-9:] - line[-9]) @ np.array([[-0.5, 0.8], [-0.8, -0.5]])  # folded back
    tracker._line = replace(tracker._line, line=line)
    found = [tracker.next(pixels, STEP, scale) for _ in range(12)]
    assert np.nanmax(errors(found[-1], curve)) < FAR
    assert np.isfinite(found[-1].pixels[1:-1]).all()


def come_off(curve, scale):
    """Return a tracker whose line has come off the first third of a DLO."""
    tracker = Tracker(COUNT)
    tracker.start(renderer().image([Instant(CAMERA, curve)]), CAMERA.project(points_of(curve)[::5]), scale)
    line = np.array(tracker._line.line)
    line[:40] = line[40] + (line[:40] - line[40]) @ np.array([[0.3, 0.9], [-0.9, 0.3]])  # turned aside
    tracker._line = replace(tracker._line, line=line)
    return tracker


def test_a_line_that_has_come_off_while_a_hand_hides_the_middle_finds_back():
    curve, scale = bent(0.9), scale_of(CAMERA)
    renderer().restart(0)
    tracker, middle = come_off(curve, scale), Hand((0.25, float(curve[200, 1]) + 0.05))
    pixels = renderer().image([Instant(CAMERA, curve, (middle,))])
    for _ in range(4):
        off = errors(tracker.next(pixels, STEP, scale), curve)
        assert np.nanmax(off) < FAR
        assert np.isfinite(off[1:9]).all() and np.isfinite(off[16:-1]).all()


def test_a_line_that_has_come_off_while_a_hand_hides_an_end_finds_back():
    curve, scale = bent(0.9), scale_of(CAMERA)
    renderer().restart(0)
    tracker, end = come_off(curve, scale), Hand((0.35, float(np.interp(0.35, curve[:, 0], curve[:, 1]))))
    pixels = renderer().image([Instant(CAMERA, curve, (end,))])
    for _ in range(4):
        off = errors(tracker.next(pixels, STEP, scale), curve)
        assert np.nanmax(off) < FAR
        assert np.isfinite(off[1:16]).all()


@pytest.mark.long
def test_beyond_a_hidden_part_a_line_that_was_assembled_counts_only_once_its_end_is_seen():
    curve, scale = bent(0.9), scale_of(CAMERA)
    renderer().restart(0)
    tracker = come_off(curve, scale)
    middle, end = Hand((0.25, float(curve[200, 1]) + 0.05)), Hand((0.01, 0.02), -2.2)
    for hands, both in (((middle, end), False), ((middle,), True)):
        pixels = renderer().image([Instant(CAMERA, curve, hands)])
        for _ in range(6):
            off = errors(tracker.next(pixels, STEP, scale), curve)
        assert np.isfinite(off[16:-1]).all()
        assert np.nanmax(off) < FAR
        assert np.isfinite(off[3:9]).all() if both else np.isnan(off[:9]).all()


@pytest.mark.long
@pytest.mark.parametrize('width, beyond', [(0.0, True), (0.05, False)])
def test_beyond_a_long_hidden_part_points_count_only_where_their_end_is_seen(width, beyond):
    def drawn(pixels, k):
        for middle, reach in ((0.25, 0.01 + width), (0.5, 0.06)) if k else ():
            sides = ((-reach, -0.3), (reach, -0.3), (reach, 0.3), (-reach, 0.3))
            corners = CAMERA.project([[middle + x, y, 0.0] for x, y in sides])
            cv2.fillPoly(pixels, [np.rint(corners).astype(np.int32)], (190, 140, 110))
        return pixels

    curve = bent(0.3)
    for one in tracked([curve] * 6, drawn=drawn)[1:]:
        off = errors(one, curve)
        assert np.isfinite(off[1:7]).all() and np.nanmax(off) < FAR
        assert np.isfinite(off[14:17]).all() == beyond


@pytest.mark.long
def test_blur_is_no_obstacle():
    curves = moving(8)
    rendered = renderer()
    before = rendered._look
    rendered._look = replace(before, blur=2.5)
    try:
        found = tracked(curves)
    finally:
        rendered._look = before
    assert np.nanmax(errors(found[-1], curves[-1])) < 2 * FAR


@pytest.mark.long
def test_a_dlo_that_is_covered_is_lost_with_a_reason_and_found_again():
    curves = [bent(0.4)] * 12
    covered = range(3, 6)

    def drawn(pixels, k):
        return np.full_like(pixels, 90) if k in covered else pixels

    found = tracked(curves, drawn=drawn)
    for k, one in enumerate(found):
        assert one.lost == (k in covered)
        assert bool(one.reason) == one.lost
        if one.lost:
            assert np.isnan(one.pixels).all()
    assert np.nanmax(errors(found[-1], curves[-1])) < FAR


@pytest.mark.long
def test_a_dlo_that_was_put_elsewhere_meanwhile_is_found_by_itself():
    curves = [bent(0.4, (0.0, -0.1))] * 3 + [None] * 3 + [bent(-0.5, (0.03, 0.12))] * 25
    found = tracked(curves)
    assert not found[2].lost
    assert found[5].lost
    assert not found[-1].lost
    assert np.nanmax(errors(found[-1], curves[-1])) < FAR
    for one, curve in zip(found[6:], curves[6:], strict=True):
        assert one.lost or np.nanmax(errors(one, curve)) < 2 * FAR


@pytest.mark.long
def test_a_picture_of_something_else_is_never_called_tracked():
    curves = [bent(0.4)] * 2 + [None] * 12
    found = tracked(curves)
    assert all(one.lost for one in found[2:])


@pytest.mark.parametrize('radius, shift, found_again', [(60.0, 40.0, True), (40.0, 70.0, False)])
def test_a_thin_loop_that_jumps_is_lost_until_all_of_it_is_found(radius, shift, found_again):
    def thin(shift):
        turn = np.linspace(2 * np.pi, 0, 200)[1:-1]
        loop = np.column_stack([240 - radius * np.sin(turn), 200 - radius * (1 - np.cos(turn))])
        loop[:, 0] += shift * ((200 - loop[:, 1]) / (2 * radius))**3
        level = np.full(150, 200.0)
        line = np.concatenate([np.column_stack([np.linspace(60, 240, 150), level]), loop,
                               np.column_stack([np.linspace(240, 420, 150), level])])
        pixels = np.full((320, 480, 3), 12, np.uint8)
        cv2.polylines(pixels, [np.rint(line * 16).astype(np.int32)], False, (170, 90, 100), 3, cv2.LINE_AA, 4)
        return cv2.GaussianBlur(pixels, (0, 0), 2.0), line

    tracker = Tracker(41)
    first, line = thin(0.0)
    tracker.start(first, line[[0, 75, 150, 175, 200, 250, 300, 325, 400, 497]])
    assert not tracker.next(first, STEP).lost
    far, _ = thin(shift)
    found = [tracker.next(far, STEP) for _ in range(8)]
    # A part that is there to be seen is not called hidden: of 39 points, the loop has 18.
    assert all(one.lost or np.isfinite(one.pixels[1:-1, 0]).sum() > 30 for one in found)
    assert found[0].lost
    assert found[-1].lost != found_again


def beside_a_sheet(curves, hands, board=BESIDE):
    """Yield what is seen of a white DLO on a table with a white sheet, and the errors (COUNT,) [m]."""
    look = plain_look(colour=(0.92, 0.92, 0.9), ground='cloth', ground_colour=(0.22, 0.25, 0.3))
    white = Renderer(replace(look, sheets=(board.sheet,)), RADIUS, (-0.3, -0.5), (0.8, 0.5))
    camera = Camera((1280, 960), 1240.0, 0.3, 0.1, 0.0, 1.0, (0.27, -0.08))
    observer = Observer(BoardFinder(Lens(camera.size, camera.matrix, np.zeros(4))), COUNT)
    for k, (curve, hand) in enumerate(zip(curves, hands, strict=True)):
        pixels = white.image([Instant(camera, curve, hand)])
        found = observer.next(k * STEP, pixels) if k else observer.start(
            0.0, pixels, camera.project(points_of(curve)[::5]) + 2.0)
        yield found, np.linalg.norm((found.points(RADIUS) - board.seen_from(points_of(curve)))[:, :2], axis=1)


@pytest.mark.long
def test_a_white_dlo_is_told_from_the_white_sheet_that_a_hand_partly_hides():
    hands = [(Hand((0.42, -0.46 + 0.05 * k)),) for k in range(5)]
    for found, off in beside_a_sheet([bent(0.4, (0.0, 0.05))] * 5, hands):
        assert not found.tracked.lost, found.tracked.reason
        assert np.isfinite(off[1:-1]).all()
        assert np.nanmax(off) < FAR


@pytest.mark.long
def test_a_white_dlo_over_a_white_sheet_is_seen_at_black_squares_alone():
    curves = [bent(0.4, (0.0, 0.05 - 0.02 * k)) for k in range(14)]
    *_, (found, off) = beside_a_sheet(curves, [()] * len(curves))
    assert not found.tracked.lost, found.tracked.reason
    assert np.isfinite(off[1:12]).all()
    assert np.nanmax(off) < FAR
    over = BESIDE.seen_from(points_of(curves[-1]))[15:, :2][np.isfinite(off[15:])]
    assert len(over)
    assert (np.floor(over / SQUARE).sum(axis=1) % 2 == 0).all()


def raised(curve, height):
    """Return a DLO whose first end is raised by a height [m]."""
    share = np.maximum(1 - np.linspace(0.0, 2.5, len(curve)), 0.0) ** 2
    return curve + height * share[:, None] * [0.0, 0.0, 1.0]


@pytest.mark.long
@pytest.mark.parametrize('column', [2, 3])
def test_a_white_dlo_that_ends_on_the_white_sheet_is_followed_under_a_hand_on_its_other_end(column):
    curves = [bent(0.4, (0.0, 0.12 - 0.02 * k)) for k in range(14)]
    place = [(column + 0.5) * SQUARE + (PAPERS['a4'].width - COLUMNS * SQUARE) / 2, 4.5 * SQUARE + BOTTOM]
    board = LaidBoard(tuple(curves[-1][-1, :2] - place))
    curves += curves[-1:] * 4
    last = [raised(curves[-1], 0.005 * max(k - 4, 0)) for k in range(16)]
    hands = [(Hand(tuple(curve[0, :2]), height=curve[0, 2] + 0.007),) for curve in last]
    *_, (found, off) = beside_a_sheet(curves + last, [()] * len(curves) + hands, board)
    assert not found.tracked.lost, found.tracked.reason
    assert np.isfinite(off[8:16]).all()
    assert np.nanmax(off[8:]) < FAR


def taped(pixels, curve, camera=CAMERA):
    """Return a picture in which wrinkled dark tape is wound around a DLO, beside both of its ends."""
    tape, thick = np.zeros(pixels.shape[:2], np.uint8), 2 * RADIUS * camera.focal_length / camera.distance
    for begin, end in ((14, 30), (370, 386)):
        points = np.rint(camera.project(curve[begin:end]) * 16).astype(np.int32)
        cv2.polylines(tape, [points], False, 255, round(thick), cv2.LINE_8, 4)
    wrinkles = np.random.default_rng(1).normal((60, 70, 100), 25.0, pixels.shape)
    return np.where(tape[..., None] > 0, np.clip(wrinkles, 0, 255), pixels).astype(np.uint8)


def test_tape_around_a_dlo_is_a_part_of_it():
    curves = moving(6)
    found = tracked(curves, drawn=lambda pixels, k: taped(pixels, curves[k]))
    for one, curve in zip(found, curves, strict=True):
        off = errors(one, curve)
        assert np.isfinite(off[1:-1]).all()
        assert np.nanmax(off) < FAR


def held_up(height):
    """Return a DLO (n, 3) [m] whose first end is held so high [m]; the other end lies on the table."""
    place = np.linspace(0.0, LENGTH, 2001)
    rise = height * np.square(np.maximum(1.0 - place / (0.8 * LENGTH), 0.0))
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(place), np.diff(rise)))])
    even = np.linspace(arc[-1] - LENGTH, arc[-1], 401)
    return np.column_stack([np.interp(even, arc, place), np.zeros(401), np.interp(even, arc, rise) + RADIUS])


@pytest.mark.long
@pytest.mark.parametrize('seed', [0, 1, 7])  # in the noise of the last ones, the hand can hardly be told
def test_a_line_reaches_the_hand_that_holds_its_end_high_above_the_table(seed):
    heights = np.concatenate([np.zeros(3), np.linspace(0.0, 0.25, 25), np.full(6, 0.25)])
    curves = [held_up(height) for height in heights]
    hands = [(Hand((curve[0, 0] - 0.01, 0.0), math.pi, curve[0, 2]),) if k else ()
             for k, curve in enumerate(curves)]
    aslant = Camera(CAMERA.size, 620.0, 0.9, 0.1, 0.0, 1.0, (0.25, 0.05))
    found = tracked(curves, hands, aslant, seed=seed)
    seen = aslant.project(curves[-1])
    for one, curve in zip(found, curves, strict=True):
        assert not one.lost
        lies = points_of(curve)[:, 2] < RADIUS + 0.001
        assert np.nanmax(errors(one, curve, aslant)[lies]) < 2 * FAR
    # The finger tips hide 2 cm of it.
    first = found[-1].pixels[np.isfinite(found[-1].pixels[:, 0])][0]
    assert np.linalg.norm(first - seen[0]) < 0.1 * np.linalg.norm(seen[0] - seen[-1])


@pytest.mark.long
def test_what_stays_on_the_table_is_right_while_a_hand_behind_the_end_lifts_it():
    heights = np.concatenate([np.zeros(3), np.linspace(0.0, 0.2, 25), np.full(3, 0.2)])
    curves = [held_up(height) for height in heights]
    hands = [(Hand(tuple(curve[40, :2]), -1.5, curve[40, 2]),) if k else () for k, curve in enumerate(curves)]
    aslant = Camera(CAMERA.size, 620.0, 0.9, 0.1, 0.0, 1.0, (0.25, 0.05))
    for one, curve in zip(tracked(curves, hands, aslant), curves, strict=True):
        lies = points_of(curve)[:, 2] < RADIUS + 0.001
        assert np.nanmax(errors(one, curve, aslant)[lies]) < 1.25 * FAR


def test_a_finger_beside_a_short_thick_dlo_of_its_colour_is_not_taken_for_it():
    def drawn(shift, finger):
        pixels = np.full((240, 320, 3), 235, np.uint8)
        cv2.line(pixels, (60, 120 + shift), (260, 120 + shift), (150, 105, 80), 16, cv2.LINE_AA)
        if finger:
            cv2.line(pixels, (160, 84 + shift), (160, 46 + shift), (150, 105, 80), 15, cv2.LINE_AA)
        return pixels

    tracker = Tracker(21)
    tracker.start(drawn(0, False), [(62, 120), (160, 120), (258, 120)])
    assert not any(tracker.next(drawn(k, True), STEP).lost for k in range(4))


@pytest.mark.long
def test_between_two_hands_the_line_does_not_go_on_sliding_when_the_dlo_has_stopped():
    # The hands come while the DLO slides along itself, and cover where it ends.
    way = np.concatenate([np.linspace(0.0, 0.06, 7), np.full(8, 0.06)])
    curves = [bent(0.15, (x - 0.06, 0.0)) for x in way]
    ends = [(curve[[0, -1], :2] + [[0.02, 0.0], [-0.02, 0.0]]).tolist() for curve in curves]
    hands = [() if k < 6 else tuple(Hand(tuple(end)) for end in ends[k]) for k in range(len(curves))]
    found = tracked(curves, hands)[-1]
    assert not found.lost
    off = errors(found, curves[-1])
    assert np.isfinite(off[4:-4]).all()
    assert np.nanmax(off) < 1.5 * FAR


def hairpin(turn):
    """Return a DLO (n, 3) [m] whose legs make an angle; the first leg stays where it is."""
    angle = turn * np.clip(np.linspace(-0.35, 0.65, 401) / 0.3, 0.0, 1.0)
    steps = np.column_stack([np.cos(angle), np.sin(angle)]) * LENGTH / 400
    flat = np.concatenate([[[0.0, 0.0]], np.cumsum(steps[:-1], axis=0)])
    return np.column_stack([flat, np.full(401, RADIUS)])


@pytest.mark.long
def test_points_stay_on_their_material_while_one_hand_brings_both_ends_together():
    turns = np.concatenate([np.linspace(2.6, 3.66, 30), np.full(30, 3.66)])
    curves = [hairpin(turn) for turn in turns]
    hands = [(Hand(tuple(curve[-1, :2] + (0.0, 0.005)), 3.6),) if k else () for k, curve in enumerate(curves)]
    for one, curve in zip(tracked(curves, hands), curves, strict=True):
        assert not one.lost
        assert np.nanmax(errors(one, curve)) < FAR
