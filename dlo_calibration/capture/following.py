# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Following: the DLO through a whole film, from a person's marks to trials."""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import dataclass
import math
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.capture.document import FilmEntry, MarkEntry
from dlo_calibration.capture.filming import Filming, HeldPoint
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import NANOSECONDS
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import episode_messages
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.episodes import Episode
from dlo_calibration.vision.film import Film
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.observer import Observer, View
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.view import BoardFinder, film_lens

FRAME = 'table'  # frame_id of the messages
ZERO = 1_700_000_000 * NANOSECONDS  # stamp of a film's first image: in 2023, as real stamps are
FEWEST = 2  # clicks of a mark


@dataclass(frozen=True, eq=False)
class FilmedTrial:
    """
    A trial of a film.

    :param trial: its times begin at `zero` of the film [s].
    """

    episode: Episode
    trial: Trial
    zero: float


@dataclass(frozen=True, eq=False)
class Followed:
    """
    What a film shows.

    :param entry: with whose marks the DLO was followed.
    :param views: of all images, in the order of time.
    :param radius: of the DLO [m]; 0: unknown.
    :param problems: in sentences.
    """

    entry: FilmEntry
    views: tuple[View, ...]
    radius: float
    trials: tuple[FilmedTrial, ...]
    problems: tuple[str, ...]

    @property
    def tracked(self) -> int:
        """The number of images in which the DLO was not lost."""
        return sum(not view.tracked.lost for view in self.views)

    def scale_at(self, time: float) -> Scale | None:
        """Return the scale of the image at a time [s]."""
        times = [view.time for view in self.views]
        return self.views[min(int(np.searchsorted(times, time)), len(times) - 1)].scale if times else None


def follow(film: Film, entry: FilmEntry, count: int, lens: Lens | None = None, *,
           on_image: Callable[[int], None] = lambda done: None,
           should_stop: Callable[[], bool] = lambda: False) -> Followed:
    """
    Follow a DLO through a film, from its first mark to both ends; each later mark corrects what follows.

    :param count: of points of the chains.
    :param lens: of the camera; None: the views of the board give the focal length.
    :param on_image: called with the number of images that are done.
    :raises InputError: where there are no marks, or nothing in the image of a mark.
    :raises CancelledError: when stopped.
    """
    marks = sorted((mark for mark in entry.marks if len(mark.clicks) >= FEWEST), key=lambda mark: mark.time)
    if not marks:
        raise InputError(f'film {entry.name}', 'no clicks', 'two or more clicks along the DLO in one image',
                         'click on both ends of the DLO, and on its bends')
    lens = film_lens(film, entry.ruler) if lens is None else lens.resized(film.size)
    views: list[View] = []
    problems: list[str] = []
    done = 0

    def seen(view: View) -> View:
        nonlocal done
        done += 1
        on_image(done)
        if should_stop():
            raise CancelledError
        return view

    for mark, end in zip(marks, [*marks[1:], None], strict=True):
        until = math.inf if end is None else end.time
        observer = Observer(BoardFinder(lens, entry.ruler))
        frames = film.frames(mark.time, until)
        first = next(frames, None)
        if first is None:
            raise InputError(f'film {entry.name}', f'clicks at {mark.time:.2f} s, after its end',
                             f'an instant of {film.duration:.1f} s', 'remove these clicks')
        try:
            views.append(seen(observer.start(first.time, first.pixels, _in_order(mark, views))))
            views += [seen(observer.next(frame.time, frame.pixels)) for frame in frames]
            if mark is marks[0] and first.time > 0.0:
                observer = Observer(BoardFinder(lens, entry.ruler))
                observer.start(first.time, first.pixels, mark.clicks)
                before = [seen(observer.next(frame.time, frame.pixels))
                          for frame in film.backwards(first.time)]
                views[:0] = before[::-1]
        except InputError as error:  # what was followed until then is kept
            if not views:
                raise
            problems.append(f'from {mark.time:.2f} s on: {error}')
    filming = Filming(tuple(HeldPoint(held.place, held.height) for held in entry.held))
    for view in views:
        filming.add(view)
    trials: list[FilmedTrial] = []
    try:
        cut, unused = filming.episodes(count)
        problems += unused
        for episode in cut:
            trial = _trial(episode, problems)
            if trial is not None:
                trials.append(FilmedTrial(episode, trial, _zero(episode, trial)))
    except InputError as error:
        problems.append(str(error))
    return Followed(entry, tuple(views), filming.radius, tuple(trials), tuple(problems))


def _in_order(mark: MarkEntry, views: Sequence[View]) -> Sequence[Sequence[float]]:
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


def _zero(episode: Episode, trial: Trial) -> float:
    """Return the time of the film at which the times of a trial begin [s]."""
    hand = episode.hands[0]
    same = next(own for own in trial.hands if own.name == hand.name)
    return hand.start - same.start
