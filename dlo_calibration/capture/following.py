# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Following: the DLO through a whole film, from a person's marks to trials."""

from __future__ import annotations

from concurrent.futures import CancelledError
from copy import copy
from dataclasses import dataclass
import math
from typing import Any, Callable, Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.capture.document import FilmedTrialEntry, FilmEntry, MarkEntry
from dlo_calibration.capture.filming import Filming, HeldPoint
from dlo_calibration.errors import InputError
from dlo_calibration.files.image_topic import ImageTopic
from dlo_calibration.messages.codec import NANOSECONDS
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import episode_messages
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.episodes import Bounds, Episode
from dlo_calibration.vision.film import Film
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.observer import ImageView, Observer
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.view import BoardFinder, film_lens

FRAME = 'table'  # frame_id of the messages
ZERO = 1_700_000_000 * NANOSECONDS  # stamp of a film's first image: in 2023, as real stamps are
FEWEST = 2  # clicks of a mark
#: What to know of a film whose lens is estimated.
WITHOUT_LENS = (
    'the focal length is estimated from the board, and may be off by some percent, which shifts what lies '
    'far from it: give the calibration of the camera, or lay the board close to the DLO')


@dataclass(frozen=True, eq=False)
class FilmedTrial:
    """A trial of a film, and the episode that it was made of."""

    episode: Episode
    trial: Trial

    def changes(self, entry: FilmEntry) -> FilmedTrialEntry:
        """Return what a person changed about it."""
        hands = self.episode.hands
        begin, end = min(hand.start for hand in hands), max(hand.end for hand in hands)
        return next((own for own in entry.trials if begin <= own.at <= end), FilmedTrialEntry(begin))

    @property
    def zero(self) -> float:
        """The time of the film at which the times of the trial begin [s]."""
        hand = self.episode.hands[0]
        return hand.start - next(own.start for own in self.trial.hands if own.name == hand.name)


@dataclass(frozen=True, eq=False)
class Followed:
    """
    Where the DLO is in each image of a film.

    :param marks: of the DLO, with which it was followed.
    :param ruler: measured length of the board's ruler line [m], likewise.
    :param lens: as it was given, likewise; None: the views of the board give the focal length.
    :param views: of all images, in the order of time.
    :param problems: in sentences.
    """

    marks: tuple[MarkEntry, ...]
    ruler: float
    lens: Lens | None
    views: tuple[ImageView, ...]
    problems: tuple[str, ...]

    @property
    def tracked(self) -> int:
        """The number of images in which the DLO was not lost."""
        return sum(not view.tracked.lost for view in self.views)

    def outdated(self, entry: FilmEntry, lens: Lens | None) -> bool:
        """Return whether the marks, the ruler or the lens have changed since."""
        return (self.marks, self.ruler, plain_lens(self.lens)) != (entry.marks, entry.ruler, plain_lens(lens))

    def scale_at(self, time: float) -> Scale | None:
        """Return the scale of the image at a time [s]."""
        times = [view.time for view in self.views]
        return self.views[min(int(np.searchsorted(times, time)), len(times) - 1)].scale if times else None


@dataclass(frozen=True, eq=False)
class FilmCut:
    """
    The trials of a film.

    :param radius: of the DLO [m]; 0: unknown.
    :param problems: in sentences.
    """

    radius: float
    trials: tuple[FilmedTrial, ...]
    problems: tuple[str, ...]


def follow(film: Film, entry: FilmEntry, lens: Lens | None = None, *,
           on_image: Callable[[int], None] = lambda done: None,
           should_stop: Callable[[], bool] = lambda: False) -> Followed:
    """
    Follow a DLO through a film, whose scale the printed board gives.

    :param lens: of the camera; None: the views of the board give the focal length.
    :param on_image: called with the number of images that are done.
    :raises InputError: where there are no marks, or nothing in the image of the first one.
    :raises CancelledError: when stopped.
    """
    problems = [WITHOUT_LENS] if lens is None else []
    used = film_lens(film, entry.ruler) if lens is None else lens.resized(film.size)

    def counted(done: int) -> None:
        on_image(done)
        if should_stop():
            raise CancelledError

    views = views_of(film, entry.marks, BoardFinder(used, entry.ruler), problems, counted)
    return Followed(entry.marks, entry.ruler, lens, tuple(views), tuple(problems))


def cut(followed: Followed, entry: FilmEntry, count: int) -> FilmCut:
    """
    Return the trials of a film, with the held points and the bounds that a person gives.

    :param count: of points of their chains.
    """
    filming = Filming(tuple(HeldPoint(held.place, held.height) for held in entry.held))
    for view in followed.views:
        filming.add(view)
    problems: list[str] = []
    bounds = [Bounds(own.at, own.start, own.end) for own in entry.trials]
    return FilmCut(filming.radius, filmed_trials(filming, count, problems, bounds), tuple(problems))


def plain_lens(lens: Lens | None) -> Any:
    """Return a lens as plain values."""
    return None if lens is None else [
        list(lens.size), lens.matrix.tolist(), lens.coefficients.tolist(), lens.fisheye]


def views_of(film: Film | ImageTopic, marks: Sequence[MarkEntry], scale: Scale | BoardFinder | None,
             problems: list[str], on_image: Callable[[int], None] = lambda done: None) -> list[ImageView]:
    """
    Follow a DLO from its first mark to both ends of a film; each later mark corrects what follows.

    What goes wrong later than in the first image ends it; why is added to `problems`.

    :param on_image: called with the number of images that are done; its KeyboardInterrupt ends it, too.
    :raises InputError: where there are no marks, or nothing in the image of the first one.
    """
    marks = sorted((mark for mark in marks if len(mark.clicks) >= FEWEST), key=lambda mark: mark.time)
    if not marks:
        raise InputError('film', 'no clicks', 'two or more clicks along the DLO in one image',
                         'click on both ends of the DLO, and on its bends')
    views: list[ImageView] = []
    earlier: list[ImageView] = []

    def keep(kept: list[ImageView], view: ImageView) -> None:
        kept.append(view)
        on_image(len(views) + len(earlier))

    try:
        for mark, after in zip(marks, [*marks[1:], None], strict=True):
            observer = Observer(copy(scale))
            frames = film.frames(mark.time, math.inf if after is None else after.time)
            first = next(frames, None)
            if first is None:
                raise InputError('clicks', f'those of the image at {mark.time:g} s (--at)',
                                 f'an instant of the film of {film.duration:.1f} s', 'choose an earlier one')
            keep(views, observer.start(first.time, first.pixels, _in_order(mark, views)))
            for frame in frames:
                keep(views, observer.next(frame.time, frame.pixels))
        if marks[0].time > 0.0:
            observer, begin = Observer(copy(scale)), views[0].time
            first = next(film.frames(begin))
            observer.start(begin, first.pixels, marks[0].clicks)
            for frame in film.backwards(begin):
                keep(earlier, observer.next(frame.time, frame.pixels))
    except InputError as error:
        if not views:
            raise
        problems.append(str(error))
    except KeyboardInterrupt:
        problems.append('interrupted; what was tracked until then is kept')
    return earlier[::-1] + views


def filmed_trials(filming: Filming, count: int, problems: list[str],
                  bounds: Sequence[Bounds] = ()) -> tuple[FilmedTrial, ...]:
    """
    Return the trials of a film, as a reader of its session makes them; why there are none goes to `problems`.

    :param count: of points of their chains.
    :param bounds: of those that shall begin or end elsewhere.
    """
    trials = []
    try:
        found, unused = filming.episodes(count, bounds)
        problems += unused
        for episode in found:
            trial = _trial(episode, problems)
            if trial is not None:
                trials.append(FilmedTrial(episode, trial))
    except InputError as error:
        problems.append(str(error))
    return tuple(trials)


def _in_order(mark: MarkEntry, views: Sequence[ImageView]) -> Sequence[Sequence[float]]:
    """Return the clicks of a mark, from the end at which the line so far begins."""
    last: Floats | None = next((view.tracked.pixels for view in reversed(views)
                                if np.isfinite(view.tracked.pixels[[0, -1]]).all()), None)
    if last is None:
        return mark.clicks
    clicks = np.asarray(mark.clicks, float)
    there, back = (float(np.linalg.norm(last[[0, -1]] - clicks[[first, -1 - first]], axis=1).sum())
                   for first in (0, -1))
    return mark.clicks if there <= back else mark.clicks[::-1]


def _trial(episode: Episode, problems: list[str]) -> Trial | None:
    """Return the trial of an episode, as a reader of its session makes it; None, and why, if none."""
    collector = TrialCollector(Options())
    span = f'{episode.start:.1f} to {episode.end:.1f} s'
    try:
        for message in episode_messages((episode,), FRAME, ZERO):
            collector.add(message)
        trials = collector.trials
    except InputError as error:
        problems.append(f'{span}: {error}')
        return None
    problems += [f'{span}: {refusal}' for refusal in collector.refusals]
    return trials[0] if trials else None
