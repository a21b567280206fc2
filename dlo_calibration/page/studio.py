# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Studio: the answers to all requests of the page, without HTTP."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
import threading
from typing import Any, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import with_nulls
from dlo_calibration.capture.document import BoardScale, Document, FilmEntry
from dlo_calibration.capture.hands import described
from dlo_calibration.capture.obstacles import scene_document
from dlo_calibration.capture.project import Project, SCENE
from dlo_calibration.capture.trial_warnings import TrialWarnings
from dlo_calibration.capture.trials import Drafter, Drafts, TrialDraft, write_request, write_session
from dlo_calibration.errors import InputError, suggestion
from dlo_calibration.evaluation.digest import digest
from dlo_calibration.files.chain_file import chain_csv, chain_xml
from dlo_calibration.files.result import read_description
from dlo_calibration.model.trial import Trial
from dlo_calibration.page.animation import animated, animated_motion
from dlo_calibration.page.calibration import ProjectCalibration
from dlo_calibration.page.film_room import FilmRoom
from dlo_calibration.page.graph import PageGraph
from dlo_calibration.page.information import Information
from dlo_calibration.planning.limits import HANDS
from dlo_calibration.planning.options import AdviceOptions
from dlo_calibration.simulation.motion import Motion
from dlo_calibration.vision.board import COLUMNS, ROWS, SQUARE
from dlo_calibration.vision.observer import jpeg_of
from dlo_calibration.vision.photograph import jpeg, png
from dlo_calibration.vision.scale import Scale
from dlo_calibration.workspace.check import checked
from dlo_calibration.workspace.folder import FILES, REQUEST, RESULT, SESSION
from dlo_calibration.workspace.source import read_source, Selection
from dlo_calibration.writing import make_folder, write_file

MOST_ANIMATIONS = 8  # in memory
LIFT = 2.0  # times that of a robot, of an advised movement
STILL = 1e-3  # m; a hand that moves less along the table goes up or down, or waits
CHAIN_FILES = {'csv': chain_csv, 'xml': chain_xml}


class UnknownName(InputError):
    """A request for a file or photograph by a name that does not exist."""


class Studio:
    """
    The project of a person, its drafts, its calibration and its result; usable from any thread.

    :param options: those of the command line, by name; they override those of the project.
    :param graph: the ROS graph; None: there is no ROS here.
    """

    def __init__(self, project: Project, make_simulator: SimulatorFactory, options: Mapping[str, Any],
                 graph: PageGraph | None) -> None:
        self.project = project
        self._make_simulator, self._given_options, self._graph = make_simulator, options, graph
        self._lock = threading.RLock()
        self._drafter = Drafter(project)
        self._information = Information(make_simulator)
        self._calibration = ProjectCalibration(project.folder, make_simulator, options)
        self._animations: dict[str, Motion] = {}  # the newest last
        self._animation_lock = threading.Lock()
        self._film_room = FilmRoom(project)
        self._fresh: list[str] = []  # ids of photographs whose tracers are not prepared yet
        self._newest: Drafts | None = None

    # What the page draws

    def state(self) -> dict[str, Any]:
        """Return everything that the page draws."""
        with self._lock:
            drafts = self._drafts.plain()
            trials = [{**trial, 'information': self._information.plain(_name(k))}
                      for k, trial in enumerate(drafts['trials'])]
            return {'revision': self.project.revision, 'document': self.project.document.plain(),
                    'photographs': drafts['photographs'], 'trials': trials, 'obstacles': drafts['obstacles'],
                    'calibration': {**self.calibration(),
                                    'result': self._calibration.plain_result(self._drafts.digest)},
                    'films': {entry.id: self._film_room.plain(entry)
                              for entry in self.project.document.films},
                    'advice': self._advice(), 'lens': self.project.lens_name, 'ros': self._graph is not None,
                    'actions': described(), 'folder': str(self.project.folder),
                    'warnings': self.project.warnings}

    def calibration(self) -> dict[str, Any]:
        """Return the state of the calibration as the page shows it, without the result."""
        with self._lock:
            return self._calibration.plain(self._drafts.digest)

    def picture(self, identity: str, width: int | None) -> bytes:
        """Return a photograph as a JPEG file, see `vision.photograph.jpeg`."""
        return jpeg(self.project.photograph(self._checked(identity)), width)

    # What the person does

    def change(self, document: Any, revision: Any) -> dict[str, Any]:
        """
        Take a changed document, and return the state.

        :param document: plain values, of any kind.
        :param revision: of the document that was changed.
        :raises InputError: where it is refused; OldRevision where another change came before.
        """
        with self._lock:
            self.project.change(Document.of(document), revision)
            return self._changed()

    def add_photograph(self, octets: bytes, name: str) -> dict[str, Any]:
        """Take a photograph's file; return its id and the state."""
        with self._lock:
            identity = self.project.add_photograph(octets, name)
            self._fresh.append(identity)
            return {'id': identity, 'state': self._changed()}

    def new_film(self) -> Path:
        """Return a path at which the content of a film can be written, for `add_film`."""
        with self._lock:
            return self.project.new_film()

    def add_film(self, path: Path, name: str) -> dict[str, Any]:
        """Take a film whose content was written; return its id and the state."""
        with self._lock:
            identity = self.project.add_film(path, name)
            return {'id': identity, 'state': self._changed()}

    def follow(self, identity: str) -> dict[str, Any]:
        """Begin to follow the DLO through a film, and return the state."""
        with self._lock:
            self._film_room.follow(self._entry(identity).id)
            return self.state()

    def set_lens(self, octets: bytes, name: str) -> dict[str, Any]:
        """Take a camera calibration, and return the state."""
        with self._lock:
            self.project.set_lens(octets, name)
            return self._changed()

    def remove_lens(self) -> dict[str, Any]:
        """Forget the camera calibration, and return the state."""
        with self._lock:
            self.project.remove_lens()
            return self._changed()

    def calibrate(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """
        Begin to calibrate, and return the state.

        :param given: options by name; only `evaluations` and `seed`.
        """
        with self._lock:
            unknown = [name for name in given if name not in ('evaluations', 'seed')]
            if unknown:
                raise InputError('calibration', f'an option {unknown[0]!r}', 'evaluations or seed',
                                 suggestion(unknown[0], ('evaluations', 'seed'), 'leave it out'))
            self._calibration.take()
            self._calibration.require_idle()
            # A scene of its own: the person may change the obstacles while it goes on.
            path = self._write(SESSION, {**given, **self._write_scene(self._calibration.folder)})
            self._information.pause()
            self._calibration.start(path, self._drafts.digest)
            return self.state()

    def stop(self) -> dict[str, Any]:
        """End the calibration with the best so far, and return the state."""
        with self._lock:
            self._calibration.stop()
            return self.state()

    # The results

    def check(self, octets: bytes, name: str) -> dict[str, Any]:
        """
        Return whether the trials still show the DLO of a result, and why, in sentences.

        :param octets: the result file; `name` is only shown.
        :raises InputError: if it cannot be read, or there is no complete trial.
        """
        file = read_description(octets, name or RESULT)
        with self._lock:
            self._information.pause()
            session = self._write(SESSION, {})
        source = read_source(Selection(session), lambda _: None, file.file_options).require_trials()
        found = checked(file, source.trials, source.options, self._make_simulator)
        return {'verdict': found.verdict, 'words': list(found.words)}

    def animation(self, number: int, identity: str) -> dict[str, Any]:
        """
        Return the simulated motion of a trial, over a photograph, see `animated`.

        :param number: of the trial, from 0.
        :raises InputError: where there is no result, no such trial, or no scale.
        """
        with self._lock:
            drafts = self._drafts.trials
            trial = drafts[number].trial if number < len(drafts) else None
            if trial is None:
                raise InputError(f'animation of trial {number + 1}', 'a trial that is not complete',
                                 'a complete trial', 'complete it as the page says')
            scale = self._drafts.photographs[self._checked(identity)].trial_scale
            if scale is None:
                raise InputError('animation', 'a photograph without a scale', 'one with a scale',
                                 'give it a scale first')
            description = self._calibration.description
            if description is None:
                raise InputError('animation', 'no result yet', 'a result', 'calibrate first')
        with self._animation_lock:  # one simulation at a time
            key = digest(description.physical(), description.file_options.values, trial)
            motion = (self._animations.pop(key, None)
                      or animated_motion(trial, description, self._make_simulator))
            self._animations[key] = motion
            if len(self._animations) > MOST_ANIMATIONS:
                del self._animations[next(iter(self._animations))]
        return animated(trial, motion, scale)

    def film_path(self, identity: str) -> Path:
        """Return the file of a film."""
        with self._lock:
            return self.project.film_path(self._entry(identity).id)

    def film_frame(self, identity: str, time: float) -> bytes:
        """Return the first image of a film from a time [s] on, as a JPEG file."""
        with self._lock:
            shown = self._film_room.film(self._entry(identity).id)
        frame = next(shown.frames(min(time, shown.duration - 1.0 / shown.frame_rate)), None)
        if frame is None:
            raise InputError('film', f'no image at {time:g} s', 'an earlier time', 'go back')
        return jpeg_of(frame.pixels)

    def film_line(self, identity: str) -> dict[str, Any]:
        """Return where the DLO was seen in a film, see `FilmRoom.line`."""
        with self._lock:
            return self._film_room.line(self._entry(identity).id)

    def film_simulated(self, identity: str) -> dict[str, Any]:
        """Return the simulated DLO over a film, see `FilmRoom.simulated`."""
        with self._lock:
            entry, description = self._entry(identity), self._calibration.description
        if description is None:
            raise InputError('film', 'no result yet', 'a result', 'calibrate first')
        with self._animation_lock:  # one simulation at a time
            return self._film_room.simulated(entry, description, self._make_simulator)

    def file(self, name: str) -> bytes:
        """
        Return a file to save: the session, the request, a file of the result, or the chain of a photograph.

        :raises InputError: where there is no such file yet.
        :raises UnknownName: where no file has that name.
        """
        with self._lock:
            if name in (SESSION, REQUEST):
                return self._saved(name).read_bytes()
            if name == SCENE:
                if not self._drafts.placed:
                    raise InputError(name, 'no obstacle yet', 'an obstacle', 'add one in the step Scale')
                self._write_scene(self.project.folder)
                return (self.project.folder / SCENE).read_bytes()
            if name in FILES:
                if name not in self._calibration.files:
                    raise InputError(name, 'no such file yet', 'a result', 'calibrate first')
                return (self._calibration.folder / name).read_bytes()
            identity, _, kind = name.partition('.')
            if kind not in CHAIN_FILES:
                raise UnknownName('file', name, 'the name of a file', 'load the page again')
            chain = self._drafts.photographs[self._checked(identity)].chain
            if chain is None:
                raise InputError('point chain', 'a photograph without a scale or a line', 'both',
                                 'give it a scale and click along the DLO first')
            return CHAIN_FILES[kind](chain)

    # ROS

    def topics(self) -> list[dict[str, str]]:
        """Return name and type of each topic with images."""
        return [] if self._graph is None else self._graph.topics()

    def add_topic_image(self, topic: str) -> dict[str, Any]:
        """Take the newest image of a topic as a photograph; return its id and the state."""
        image = self._required_graph().image(topic)
        octets = image.picture
        if not isinstance(octets, bytes):
            octets = png(octets)
        with self._lock:
            if image.lens is not None:
                self.project.set_lens(image.lens, f'camera_info of {topic}')
            return self.add_photograph(octets, topic)

    def send(self, namespace: str) -> str:
        """Send all complete trials to a running calibrator; return its answer."""
        with self._lock:
            trials = self._complete()
        return self._required_graph().send(trials, namespace)

    # Background work

    def tick(self) -> tuple[str, ...]:
        """Process the news of the background work; return the names of the methods with new values."""
        with self._lock:
            news = []
            _ = self._drafts  # of a newly opened project
            if self._fresh:
                with suppress(InputError):
                    self._drafter.prepare(self._fresh.pop(0))  # while the person looks at it
            film_news = self._film_room.take()
            if film_news == 'trials':
                self._newest = None
                news.append('state')
            elif film_news:
                news.append('films')
            if self._calibration.take():
                news.append('calibration' if self._calibration.busy else 'state')
            if self._calibration.written.is_set():
                self._calibration.written.clear()
                news.append('state')
            if not self._calibration.busy and self._information.take():
                news += ['information', 'advice']
            return tuple(dict.fromkeys(news))

    def films(self) -> list[dict[str, Any]]:
        """Return how far the following of each film is that is followed."""
        with self._lock:
            return [{'id': entry.id, 'progress': progress} for entry in self.project.document.films
                    if (progress := self._film_room.progress(entry.id)) is not None]

    def advice(self) -> dict[str, Any]:
        """Return what to do next, as far as it is known."""
        with self._lock:
            return {'advice': self._advice()}

    def information(self) -> list[dict[str, Any]]:
        """Return the information of each trial, as far as it is known, with its number from 0."""
        with self._lock:
            numbered = ((k, self._information.plain(_name(k))) for k in range(len(self._drafts.trials)))
            return [{'trial': k, **information} for k, information in numbered if information is not None]

    def close(self) -> None:
        """End the background work; everything else is on the disk already."""
        with self._lock:
            self._information.close()
            self._film_room.close()
            self._calibration.close()
            if self._graph is not None:
                self._graph.close()

    # Internals

    def _changed(self) -> dict[str, Any]:
        self._newest = None
        return self.state()

    @property
    def _drafts(self) -> Drafts:
        """The drafts of the present document, made at the first use."""
        if self._newest is None:
            self._newest = self._with_films(self._drafter.draft())
            trials = [draft.trial for draft in self._newest.trials if draft.trial is not None]
            with suppress(InputError):  # a calibration is refused with the reason
                self._write_scene(self.project.folder)
            self._information.want(trials, self._options({}), digest(*self._newest.obstacles),
                                   self._limits(trials))
        return self._newest

    def _with_films(self, drafts: Drafts) -> Drafts:
        """Return drafts with the trials of the films behind those of the photographs."""
        filmed = [TrialDraft(TrialWarnings(), trial=own.trial, name=own.changes(entry).name)
                  for entry in self.project.document.films for own in self._film_room.used(entry)]
        first = len(drafts.trials)
        named = [replace(draft, trial=draft.trial and replace(draft.trial, name=_name(first + k)))
                 for k, draft in enumerate(filmed)]
        return replace(drafts, trials=(*drafts.trials, *named),
                       filmed_diameter=2.0 * self._film_room.radius or None)

    def _last_view(self, drafts: Drafts) -> tuple[str, Scale] | None:
        """Return the id of the photograph or film that ends the last trial, and its scale; None: unknown."""
        if not drafts.trials or drafts.trials[-1].trial is None:
            return None
        for entry in reversed(self.project.document.films):
            used = self._film_room.used(entry)
            if used:
                scale = self._film_room.scale_at(entry.id, used[-1].zero + used[-1].trial.goals[-1].time)
                return None if scale is None else (entry.id, scale)
        goal = self.project.document.trials[-1].goal or ''
        scale = drafts.photographs[goal].scale if goal in drafts.photographs else None
        return None if scale is None else (goal, scale)

    def _limits(self, trials: Sequence[Trial]) -> AdviceOptions | None:
        """Return what a person's hand may do next: what the last picture shows, and not on the board."""
        view = None if self._newest is None else self._last_view(self._newest)
        if view is None or not trials:
            return None
        width, height = view[1].size
        corners = view[1].points([(u, v) for u in (0.0, width - 1.0) for v in (0.0, height - 1.0)])
        low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
        reach = '' if np.isnan(corners).any() else \
            f'box {low[0]:.3f} {low[1]:.3f} -1 {high[0]:.3f} {high[1]:.3f} 1'
        boards = any(isinstance(entry.scale, BoardScale) for entry in self.project.document.photographs)
        lift = LIFT * AdviceOptions().of_length(trials[-1].initial.length).height
        return AdviceOptions(height=lift, pause=0.0, reach_1=reach, no_go=(
            f'0 0 -1 {COLUMNS * SQUARE:.3f} {ROWS * SQUARE:.3f} 0.01',) * boards)

    def _advice(self) -> dict[str, Any] | None:
        """
        Return what to do next as the page shows it; None: it is not known yet.

        :returns: `words`; `view`: the id of the photograph or film on which it is drawn; `ways`: for each
            hand, its pixels on the table, from where it grips to where it opens.
        """
        advice, view = self._information.advice, self._last_view(self._drafts)
        if advice is None or view is None:
            return None
        ways = []
        for hand in () if advice.action is None else advice.action.hands:
            flat = np.column_stack([hand.positions[:, :2], np.full(len(hand.times), hand.positions[0, 2])])
            turns = np.append(True, np.linalg.norm(np.diff(flat, axis=0), axis=1) > STILL)
            ways.append(np.round(view[1].to_pixels(flat[turns]), 1).tolist())
        said = advice.words.removeprefix(f'{HANDS[0]}: ')
        return {'words': said[:1].upper() + said[1:], 'view': view[0], 'ways': with_nulls(ways)}

    def _entry(self, identity: str) -> FilmEntry:
        """
        Return a film of the document, given by its id.

        :raises UnknownName: if it is not there.
        """
        entry = next((film for film in self.project.document.films if film.id == identity), None)
        if entry is None:
            raise UnknownName('film', identity, 'the id of a film of the project', 'load the page again')
        return entry

    def _complete(self) -> tuple[Trial, ...]:
        """Return the complete trials."""
        trials = self._drafts.complete
        if not trials:
            raise InputError('project', 'no complete trial', 'a start, a goal, and what the hands did',
                             'complete a trial as the page says')
        return trials

    def _write(self, name: str, given: Mapping[str, Any]) -> Path:
        """Write the session or request of the trials as they are now; return its path."""
        self._write_scene(self.project.folder)
        path, write = self.project.folder / name, write_session if name == SESSION else write_request
        write(path, self._complete(), self._options(given).flat())
        return path

    def _saved(self, name: str) -> Path:
        """Write the session or request that gives `fit` the numbers of the page; return its path."""
        result, description = self._calibration.result, self._calibration.description
        unchanged = result is not None and result.digest == self._drafts.digest
        options = description.file_options.values if unchanged and description is not None else {}
        return self._write(name, options)

    def _options(self, given: Mapping[str, Any]) -> Options:
        scene = {'scene': _scene(self.project.folder)} if self._drafts.placed else {}
        return Options.of({**self._drafts.options, **scene, **self._given_options, **given})

    def _write_scene(self, folder: Path) -> dict[str, str]:
        """
        Write the obstacles, if there are any, to a folder; return the option that names the file.

        :raises InputError: if one of them cannot be placed, or the file cannot be written.
        """
        for placed in self._drafts.placed:
            if isinstance(placed, InputError):
                raise placed
        if not self._drafts.placed:
            return {}
        make_folder(folder)
        write_file(folder / SCENE, scene_document(self._drafts.obstacles))
        return {'scene': _scene(folder)}

    def _checked(self, identity: str) -> str:
        """
        Return the id of a photograph of the document.

        :raises UnknownName: if it is not there.
        """
        if identity not in self.project.document.by_id:
            raise UnknownName('photograph', identity, 'the id of a photograph of the project',
                              'load the page again')
        return identity

    def _required_graph(self) -> PageGraph:
        if self._graph is None:
            raise InputError('ROS', 'no ROS 2 here', 'an installation of ROS 2 that is sourced',
                             'source it and start the page again')
        return self._graph


def _scene(folder: Path) -> str:
    return str((folder / SCENE).resolve())


def _name(number: int) -> str:
    return f'trial {number + 1}'
