# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""FilmRoom: follows the DLO through the films of a project in the background, and shows what was seen."""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
import time
from typing import Any, Callable, Sequence

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.capture.document import FilmEntry
from dlo_calibration.capture.followed_file import read_followed, write_followed
from dlo_calibration.capture.following import cut, FEWEST, FilmCut, FilmedTrial, follow, Followed
from dlo_calibration.capture.project import Project
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import Description
from dlo_calibration.model.chain import Floats
from dlo_calibration.page.animation import animated_motion
from dlo_calibration.vision.film import Film
from dlo_calibration.vision.scale import Scale
from dlo_calibration.workspace.worker import Background, Failure

SHOWN = 2  # of so many points of the DLO, the page gets one
HANGS = 1.0  # s after a film's last goal in which the simulated DLO is still shown


@dataclass
class _FilmProgress:
    """How far the following of a film is."""

    identity: str
    images: int
    begin: float
    done: int = 0


@dataclass(frozen=True, eq=False)
class _Cut:
    """
    A film that was cut into trials.

    :param of: what it depends on, see `_choices`.
    """

    of: object
    cut: FilmCut


class FilmRoom:
    """
    Follows one film after the other; usable from any thread that holds the studio's lock.

    What was followed is kept in the project's folder.  It is cut into trials again whenever the person
    changes what they depend on.
    """

    def __init__(self, project: Project) -> None:
        self._project = project
        self._work: Background[tuple[str, Followed, str]] = Background('film')
        self._cutting: Background[FilmCut] = Background('cut')
        self._being_cut: tuple[str, object] = '', None
        self._films: dict[str, Film] = {}
        self._problems: dict[str, str] = {}
        self._progress: _FilmProgress | None = None
        self._waiting = [film.id for film in project.document.films if _marked(film)]
        self._kept = set(self._waiting)  # of which the folder may say where the DLO is
        self._followed: dict[str, Followed] = {}
        self._cuts: dict[str, _Cut] = {}

    def film(self, identity: str) -> Film:
        """Return a film, given by its id."""
        if identity not in self._films:
            self._films[identity] = self._project.film(identity)
        return self._films[identity]

    def follow(self, identity: str) -> None:
        """Follow the DLO through a film, once those that were asked for before are done."""
        self._problems.pop(identity, None)
        self._kept.discard(identity)
        if self._progress is not None and self._progress.identity == identity:
            self._work.stop()
        if identity not in self._waiting:
            self._waiting.append(identity)

    def take(self) -> str:
        """Take news of the work, and begin the next; return what has changed: trials, progress, or ''."""
        news = ''
        for event in self._work.waiting_events():
            progress, self._progress = self._progress, None
            news = 'trials'
            if isinstance(event, Failure):
                if progress is not None and not self._work.stopped:
                    self._problems[progress.identity] = event.text
            else:
                self._followed[event[0]], problem = event[1:]
                if problem:
                    self._problems[event[0]] = problem
        for done in self._cutting.waiting_events():
            news = 'trials'
            identity, of = self._being_cut
            made = FilmCut(0.0, (), (done.text,)) if isinstance(done, Failure) else done
            self._cuts[identity] = _Cut(of, made)
        if not self._cutting.alive:
            self._cut_next()
        if not self._work.alive and self._progress is None and self._waiting:
            self._begin(self._waiting.pop(0))
            return 'trials'
        return news or ('progress' if self._work.alive else '')

    def _begin(self, identity: str) -> None:
        entry = next((film for film in self._project.document.films if film.id == identity), None)
        if entry is None:  # it was removed
            return
        try:
            film = self.film(identity)
        except InputError as error:
            self._problems[identity] = str(error)
            return
        progress = _FilmProgress(identity, max(1, round(film.duration * film.frame_rate)), time.monotonic())
        self._progress = progress
        path, lens = self._project.followed_path(identity), self._project.lens
        may_be_kept = identity in self._kept

        def on_image(done: int) -> None:
            progress.done = done

        def work(should_stop: Callable[[], bool]) -> tuple[str, Followed, str]:
            kept = read_followed(path) if may_be_kept else None
            if kept is not None:
                return identity, kept, ''
            try:
                followed = follow(film, entry, lens, on_image=on_image, should_stop=should_stop)
            except CancelledError as error:
                raise InputError('film', 'a stop', 'its end', 'follow it again') from error
            try:
                write_followed(path, followed)
            except InputError as error:
                return identity, followed, str(error)
            return identity, followed, ''

        self._work.begin(work)

    def _cut_next(self) -> None:
        """Begin to cut the first film whose trials are not those that it and its entry make now."""
        points = self._project.document.dlo.points
        for entry in self._project.document.films:
            followed = self._followed.get(entry.id)
            if followed is None:
                continue
            known, of = self._cuts.get(entry.id), _choices(followed, entry, points)
            if known is None or known.of != of:
                self._being_cut = entry.id, of
                self._cutting.begin(partial(_cut, followed, entry, points))
                return

    def cut(self, identity: str) -> FilmCut | None:
        """Return the trials of a film, as far as they are known."""
        known = self._cuts.get(identity)
        return None if known is None else known.cut

    def used(self, entry: FilmEntry) -> list[FilmedTrial]:
        """Return the trials of a film that a person uses."""
        known = self.cut(entry.id)
        return [] if known is None else [own for own in known.trials if own.changes(entry).used]

    def scale_at(self, identity: str, time: float) -> Scale | None:
        """Return the scale of a film that was followed, at a time [s]."""
        return self._required(identity).scale_at(time)

    @property
    def radius(self) -> float:
        """Radius of the DLO [m], as a film shows it; 0: none does."""
        return next((known.cut.radius for known in self._cuts.values() if known.cut.radius > 0), 0.0)

    def plain(self, entry: FilmEntry) -> dict[str, Any]:
        """Return the state of a film as the page shows it."""
        values: dict[str, Any] = {
            'problem': self._problems.get(entry.id), 'progress': self.progress(entry.id),
            'waiting': entry.id in self._waiting}
        try:
            film = self.film(entry.id)
            values.update(width=film.size[0], height=film.size[1], duration=film.duration,
                          frame_rate=film.frame_rate)
        except InputError as error:
            values['problem'] = str(error)
        followed, known = self._followed.get(entry.id), self._cuts.get(entry.id)
        if followed is not None and known is not None:
            values.update(
                images=len(followed.views), tracked=followed.tracked,
                problems=[*followed.problems, *known.cut.problems],
                outdated=followed.outdated(entry, self._project.lens),
                cutting=known.of != _choices(followed, entry, self._project.document.dlo.points),
                trials=[_plain_trial(own, entry) for own in known.cut.trials])
        return values

    def progress(self, identity: str) -> dict[str, Any] | None:
        """Return how far the following of a film is; None: it is not under way."""
        progress = self._progress
        if progress is None or progress.identity != identity:
            return None
        spent = time.monotonic() - progress.begin
        left = spent / max(progress.done, 1) * max(progress.images - progress.done, 0)
        return {'done': progress.done, 'images': progress.images, 'left': left if progress.done else None}

    def line(self, identity: str) -> dict[str, Any]:
        """
        Return where the DLO was seen in each image: `times` [s], and `pixels`, null where it was not.

        :raises InputError: where the film was not followed.
        """
        views = self._required(identity).views
        return {'times': [round(view.time, 4) for view in views],
                'pixels': [_pixels(view.tracked.pixels[::SHOWN]) for view in views],
                'width': float(np.median([view.tracked.width for view in views]))}

    def simulated(self, entry: FilmEntry, description: Description, make_simulator: SimulatorFactory
                  ) -> dict[str, Any]:
        """
        Return the simulated DLO over a film: `times` [s] and `pixels`, of all trials that are used.

        :raises InputError: where the film was not followed.
        """
        followed, times, pixels = self._required(entry.id), list[float](), list[Any]()
        for own in self.used(entry):
            motion = animated_motion(own.trial, description, make_simulator)
            for instant, chain in zip(motion.times, motion.chains, strict=True):
                shown = float(instant) + own.zero
                scale = followed.scale_at(shown)
                if scale is not None and shown <= own.episode.goals[-1][0] + HANGS:
                    times.append(round(shown, 4))
                    pixels.append(_pixels(scale.to_pixels(chain)))
        return {'times': times, 'pixels': pixels}

    def close(self) -> None:
        """End the work."""
        self._waiting.clear()
        self._work.stop()
        self._work.join(5.0)
        self._cutting.join(5.0)

    def _required(self, identity: str) -> Followed:
        followed = self._followed.get(identity)
        if followed is None:
            raise InputError('film', 'a film that was not followed yet', 'a line along the DLO',
                             'click along the DLO, and follow it')
        return followed


def _cut(followed: Followed, entry: FilmEntry, points: int, should_stop: object) -> FilmCut:
    return cut(followed, entry, points)


def _marked(entry: FilmEntry) -> bool:
    return any(len(mark.clicks) >= FEWEST for mark in entry.marks)


def _choices(followed: Followed, entry: FilmEntry, points: int) -> object:
    """Return what the cut of a film depends on."""
    return id(followed), entry.held, points, [(own.at, own.start, own.end) for own in entry.trials]


def _plain_trial(own: FilmedTrial, entry: FilmEntry) -> dict[str, Any]:
    """Return a trial of a film as the page shows it."""
    return {
        'start': own.episode.start, 'end': own.episode.end, 'goals': len(own.trial.goals),
        'latest_start': own.episode.latest_start, 'earliest_end': own.episode.earliest_end,
        'hands': [{'name': hand.name, 'place': place, 'closes': hand.start, 'opens': hand.end}
                  for hand, place in zip(own.episode.hands, own.episode.places, strict=True)],
        'used': own.changes(entry).used}


def _pixels(points: Floats) -> Sequence[Any]:
    """Return pixels rounded to a tenth, as a screen shows no more; None for those that were not seen."""
    return [None if not np.isfinite(point).all() else point for point in np.round(points, 1).tolist()]
