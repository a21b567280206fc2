# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `track`: follows a DLO and hands through a film, and writes a session of trials."""

from __future__ import annotations

import argparse
from itertools import chain, pairwise
from pathlib import Path
import time
from typing import Any, cast, Iterator, Sequence

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.capture.document import MarkEntry
from dlo_calibration.capture.filming import Filming, HeldPoint
from dlo_calibration.capture.following import filmed_trials, FilmedTrial, FRAME, views_of, WITHOUT_LENS, ZERO
from dlo_calibration.capture.trials import FILM_ERRORS, measured_options
from dlo_calibration.cli.output import print_json, print_message, standard_output
from dlo_calibration.cli.trace import check_count, pixels_of, places_of
from dlo_calibration.errors import InputError
from dlo_calibration.files.image_topic import ImageTopic, read_image_topic
from dlo_calibration.files.recording import write_records
from dlo_calibration.files.session import message_records
from dlo_calibration.messages.encoder import episode_messages
from dlo_calibration.vision.film import Film, read_film
from dlo_calibration.vision.lens import read_lens
from dlo_calibration.vision.observer import drawn, FilmWriter, ImageView
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.view import BoardFinder, film_lens
from dlo_calibration.workspace.folder import SESSION

TRACKED = 'tracked.mp4'
PROGRESS = 2.0  # s between two lines about progress
BORDER = 3.0  # px; a DLO whose end is nearer to the picture's border goes on beyond it
LOST_LISTED = 5  # intervals in which the DLO is lost, of which the problems tell

Source = Film | ImageTopic


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('video', metavar='VIDEO', type=Path,
                        help='a film (mp4, mov, webm, mkv, avi), or a recorded session with --image')
    parser.add_argument('--points', metavar='"u,v u,v ..."', required=True,
                        help='two or more pixels along the DLO, in order, from one end to the other')
    parser.add_argument('--at', type=float, default=0.0, metavar='SECONDS',
                        help='instant of the image in which these pixels are (default: the first image)')
    parser.add_argument('--image', metavar='TOPIC', help='the images on this topic of a recorded session')
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument('--scale', metavar='"u,v=x,y ..."',
                       help='four or more pixels and where they are on the table [m]; the camera must stand')
    scale.add_argument('--board', action='store_true', help='the printed board lies beside the DLO')
    parser.add_argument('--camera', metavar='FILE', type=Path,
                        help='YAML of a ROS camera calibration, against lens distortion')
    parser.add_argument('--held', metavar='"u,v[,HEIGHT] ..."', default='',
                        help='the pixel of each point that a hand without a tag holds, in the same image, '
                        'and how high the hand holds it [m] (default: on the table)')
    parser.add_argument('--count', type=int, default=21, metavar='N',
                        help='points of the chains (default: 21)')
    parser.add_argument('--output', metavar='DIR', type=Path,
                        help=f'write {SESSION}, and the film with the line, {TRACKED}, into this folder')
    parser.add_argument('--json', action='store_true', help='print one JSON document')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    check_count(chosen.count)
    clicks, marks = pixels_of(chosen.points, '--points'), _marks(chosen.held)
    film: Source = read_film(chosen.video) if chosen.image is None else read_image_topic(
        chosen.video, chosen.image)
    scale = _scale(chosen, film)
    problems = [WITHOUT_LENS] if chosen.board and chosen.camera is None else []
    begin = time.perf_counter()
    progress = _Progress(max(round(film.duration * film.frame_rate), 1))
    clicked = MarkEntry(chosen.at, tuple(map(tuple, clicks.tolist())))
    views = views_of(film, [clicked], scale, problems, progress.tell)
    spent = time.perf_counter() - begin
    filming = Filming(_held(marks, views, chosen.at))
    for view in views:
        filming.add(view)
    trials = filmed_trials(filming, chosen.count, problems)
    problems += _about(views, film)
    if chosen.output is not None:
        chosen.output.mkdir(parents=True, exist_ok=True)
        if trials:
            messages = episode_messages([own.episode for own in trials], FRAME, ZERO)
            write_records(chosen.output / SESSION, message_records(messages),
                          measured_options(round(2.0 * filming.radius, 4), errors=FILM_ERRORS))
        _draw(film, views, chosen.output / TRACKED)
    elapsed = time.perf_counter() - begin
    report = _report(views, filming, trials, problems, spent, elapsed)
    if chosen.json:
        print_json(report)
    else:
        _print(report, chosen.output, bool(trials))
    return 0


def _marks(text: str) -> list[tuple[float, float, float]]:
    """Return pixels and heights of the option --held."""
    marks = []
    for word in text.split():
        u, _, rest = word.partition(',')
        v, _, height = rest.partition(',')
        (pixel,) = pixels_of(f'{u},{v}', '--held')
        try:
            marks.append((*pixel.tolist(), float(height or 0.0)))
        except ValueError as error:
            raise InputError('--held', repr(word), 'u,v or u,v,HEIGHT',
                             'give the height in metres') from error
    return marks


def _scale(chosen: argparse.Namespace, film: Source) -> Scale | BoardFinder | None:
    """Return the scale that the command line asks for."""
    lens = None if chosen.camera is None else read_lens(chosen.camera)
    if chosen.board:
        return BoardFinder(film_lens(cast(Film, film)) if lens is None else lens.resized(film.size))
    if chosen.scale:
        return scale_from_points(*places_of(chosen.scale), film.size, lens)
    return None


class _Progress:
    """Lines on stderr: how far the tracker is, and the time left."""

    def __init__(self, expected: int) -> None:
        self._expected, self._begin = expected, time.monotonic()
        self._told = self._begin

    def tell(self, done: int) -> None:
        """Print a line if the last one is old enough."""
        now = time.monotonic()
        if now - self._told < PROGRESS:
            return
        self._told = now
        rate = done / (now - self._begin)
        print_message(f'image {done} of about {self._expected}, {rate:.1f} a second, '
                      f'{max(self._expected - done, 0) / rate:.0f} s left')


def _held(marks: Sequence[tuple[float, float, float]], views: Sequence[ImageView],
          at: float) -> list[HeldPoint]:
    """Return the places along the DLO that are nearest to pixels of the image at an instant."""
    held = []
    clicked = min(views, key=lambda view: (view.time < at, abs(view.time - at)))
    for u, v, height in marks:
        away = np.linalg.norm(clicked.tracked.pixels - (u, v), axis=1)
        nearest = int(np.nanargmin(away))
        if away[nearest] > max(3.0 * clicked.tracked.width, 10.0):
            raise InputError('--held', f'{u:g},{v:g}, {away[nearest]:.0f} pixels beside the DLO',
                             'a pixel on the DLO', 'click on it in the image in which its points are')
        held.append(HeldPoint(nearest / (len(away) - 1), height))
    return held


def _about(views: Sequence[ImageView], film: Source) -> list[str]:
    """Return sentences about where the DLO was lost, and where it is not whole in the picture."""
    problems = []
    spans = _lost(views)
    for begin, end in spans[:LOST_LISTED]:
        reason = next(view.tracked.reason for view in views if view.time >= begin and view.tracked.lost)
        problems.append(f'{begin:.2f} to {end:.2f} s: the DLO is lost: {reason}')
    if len(spans) > LOST_LISTED:
        problems.append(f'the DLO is lost {len(spans) - LOST_LISTED} times more')
    width, height = film.size
    low, high = np.array([BORDER, BORDER]), np.array([width - 1 - BORDER, height - 1 - BORDER])
    for name, place in (('first', 0), ('last', -1)):
        ends = np.array([view.tracked.pixels[place] for view in views])
        known = np.isfinite(ends[:, 0])
        beyond = known & ~((ends > low) & (ends < high)).all(axis=1)
        if beyond.any():
            when = views[int(beyond.argmax())].time
            problems.append(f'the film shows only a part of the DLO: its {name} end is at the border of the '
                            f'picture at {when:.2f} s; film from farther away')
    return problems


def _lost(views: Sequence[ImageView]) -> list[tuple[float, float]]:
    """Return from when to when the DLO was lost."""
    flags = np.concatenate([[False], [view.tracked.lost for view in views], [False]]).astype(int)
    edges = np.flatnonzero(np.diff(flags)).reshape(-1, 2)
    return [(views[a].time, views[min(b, len(views) - 1)].time) for a, b in edges]


def _draw(film: Source, views: Sequence[ImageView], path: Path) -> None:
    """Write the film with the line."""
    writer = None
    waiting: Iterator[ImageView | None] = chain(views, [None])
    view = next(waiting)
    try:
        for frame in film.frames(views[0].time):
            while view is not None and view.time < frame.time - 1e-6:
                view = next(waiting)
            if view is None:
                break
            picture = drawn(frame.pixels, view if abs(view.time - frame.time) < 1e-6 else None)
            if writer is None:
                writer = FilmWriter(str(path), picture.shape[1::-1], _rate(views))
            writer.write(picture)
    except InputError as error:  # the session is there, which is what counts
        print_message(str(error))
    finally:
        if writer is not None:
            writer.close()


def _rate(views: Sequence[ImageView]) -> float:
    """Return the images in a second, for a film with an even rate."""
    lapses = [after.time - before.time for before, after in pairwise(views)]
    return float(np.clip(1.0 / np.median(lapses), 1.0, 240.0)) if lapses else 30.0


def _report(views: Sequence[ImageView], filming: Filming, trials: Sequence[FilmedTrial],
            problems: Sequence[str], spent: float, elapsed: float) -> dict[str, Any]:
    return {
        'frames': len(views), 'tracked': sum(not view.tracked.lost for view in views),
        'fps': len(views) / spent, 'seconds': elapsed, 'length_m': _length(filming, views),
        'diameter_m': 2.0 * filming.radius or None,
        'trials': [{'start_s': own.episode.start, 'end_s': own.episode.end, 'hands': [
            {'name': hand.name, 'grip_fraction': place, 'closes_s': hand.start, 'opens_s': hand.end}
            for hand, place in zip(own.episode.hands, own.episode.places, strict=True)],
            'goals': len(own.trial.goals)} for own in trials],
        'lost': [list(span) for span in _lost(views)], 'problems': list(problems)}


def _length(filming: Filming, views: Sequence[ImageView]) -> float | None:
    """Return the median length of the DLO where all of it was seen [m]; None: never, or without a scale."""
    lengths = []
    for view in views:
        points = view.points(filming.radius)
        if np.isfinite(points[:, 0]).all():
            lengths.append(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return float(np.median(lengths)) if lengths else None


def _print(report: dict[str, Any], output: Path | None, written: bool) -> None:
    """Print the report as text."""
    with standard_output() as stream:
        length = report['length_m']
        stream.write(f'{report["tracked"]} of {report["frames"]} images tracked, {report["fps"]:.1f} a second'
                     f'{"" if length is None else f"; DLO {1000 * length:.0f} mm long"}\n')
        for number, trial in enumerate(report['trials'], start=1):
            hands = ', '.join(f'{hand["name"]} holds it at {100 * hand["grip_fraction"]:.0f} % of its length '
                              f'from {hand["closes_s"]:.1f} to {hand["opens_s"]:.1f} s'
                              for hand in trial['hands'])
            stream.write(f'trial {number}: {hands}; {trial["goals"]} goals\n')
        for problem in report['problems']:
            stream.write(f'{problem}\n')
        if output is not None:
            stream.write(f'{output / SESSION if written else "no session, as there is no trial"}; '
                         f'{output / TRACKED}\n')
        elif report['trials']:
            stream.write('give --output DIR to write the session\n')
