# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Studio: everything that the page asks for; it makes all decisions, and knows nothing of HTTP."""

from __future__ import annotations

from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
import threading
from typing import Any, Mapping

import cv2

from dlo_calibration.calibration.options import Options
from dlo_calibration.capture import saving
from dlo_calibration.capture.calibrating import Calibrating, FILES
from dlo_calibration.capture.connections import Connections, Graph
from dlo_calibration.capture.document import Document
from dlo_calibration.capture.film import film, filmed
from dlo_calibration.capture.information import Information
from dlo_calibration.capture.interpretation import Interpretation, Interpreter
from dlo_calibration.capture.pictures import Pictures
from dlo_calibration.capture.project import Project
from dlo_calibration.capture.steps import KINDS
from dlo_calibration.errors import InputError, meant
from dlo_calibration.evaluation.log import digest
from dlo_calibration.files.chain_file import chain_csv, chain_xml
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.motion import Motion

KEPT_FILMS = 8  # in memory
SESSION, REQUEST = 'session.mcap', 'request.xml'


class NotThere(InputError):
    """Something by a name that nothing has."""


@dataclass(frozen=True, eq=False)
class _Read:
    """
    What the document means.

    :param trials: in its order, each with a name of its own; None: it is not complete.
    :param digest: of the trials and their options.
    """

    found: Interpretation
    trials: tuple[Trial | None, ...]
    digest: str


class Studio:
    """
    What a person does to a project, and what comes of it; usable from any thread.

    :param connections: what it uses of the rooms after this one.
    """

    def __init__(self, project: Project, connections: Connections) -> None:
        self.project = project
        self._connections = connections
        self._lock = threading.RLock()
        self._pictures = Pictures(project.photograph)
        self._interpreter = Interpreter(project)
        self._information = Information(connections.make_simulator)
        self._calibrating = Calibrating(project.folder, connections)
        self._films: OrderedDict[str, Motion] = OrderedDict()
        self._film_lock = threading.Lock()
        self._written = 0  # revision of the calibration's files when they were last told
        self._fresh: list[str] = []  # ids of photographs that nobody has clicked on yet
        self._newest: _Read | None = None

    # What the page draws

    def state(self) -> dict[str, Any]:
        """Return all that the page draws."""
        with self._lock:
            found = self._read.found.plain()
            trials = [{**one, 'information': self._information.plain(_name(k))}
                      for k, one in enumerate(found['trials'])]
            return {'revision': self.project.revision, 'document': self.project.document.plain(),
                    'photographs': found['photographs'], 'trials': trials,
                    'calibration': {**self.calibration(),
                                    'result': self._calibrating.plain_result(self._read.digest)},
                    'lens': self.project.lens_name, 'ros': self._connections.graph is not None,
                    'actions': _ACTIONS, 'folder': str(self.project.folder),
                    'problems': list(self.project.problems)}

    def calibration(self) -> dict[str, Any]:
        """Return what the page shows of the calibration, without the result."""
        with self._lock:
            return self._calibrating.plain(self._read.digest)

    def picture(self, identity: str, width: int | None) -> bytes:
        """Return a photograph as a JPEG file, see `Pictures.jpeg`."""
        return self._pictures.jpeg(self._known(identity), width)

    # What the person does

    def change(self, document: Any, revision: Any) -> dict[str, Any]:
        """
        Take a changed document, and return the state.

        :param document: plain values, of any kind.
        :param revision: that it was made from.
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
                                 meant(unknown[0], ('evaluations', 'seed'), 'leave it out'))
            self._calibrating.take()
            path = self._write_session(given)
            self._information.pause()
            self._calibrating.start(path, self._read.digest)
            return self.state()

    def stop(self) -> dict[str, Any]:
        """End the calibration with the best so far, and return the state."""
        with self._lock:
            self._calibrating.stop()
            return self.state()

    # What comes of it

    def film(self, number: int, identity: str) -> dict[str, Any]:
        """
        Return the simulated motion of a trial, over a photograph, see `film`.

        :param number: of the trial, from 0.
        :raises InputError: where there is no result, no such trial, or no scale.
        """
        with self._lock:
            trial = dict(enumerate(self._read.trials)).get(number)
            if trial is None:
                raise InputError(f'film of trial {number + 1}', 'a trial that is not complete',
                                 'a complete trial', 'see what it lacks')
            scale = self._read.found.photographs[self._known(identity)].scale
            if scale is None:
                raise InputError('film', 'a photograph without a scale', 'one with a scale',
                                 'give it a scale first')
            found = self._calibrating.found
            if found is None:
                raise InputError('film', 'no result yet', 'a result', 'calibrate first')
        with self._film_lock:  # one simulation at a time
            key = digest(found.physical(), found.options, trial)
            if key not in self._films:
                self._films[key] = filmed(trial, found, self._connections.make_simulator)
                while len(self._films) > KEPT_FILMS:
                    self._films.popitem(last=False)
            self._films.move_to_end(key)
            motion = self._films[key]
        return film(trial, motion, scale)

    def file(self, name: str) -> bytes:
        """
        Return a file to save: the session, the request, a file of the result, or the chain of a photograph.

        :raises InputError: where there is no such file yet.
        :raises NotThere: where no file has that name.
        """
        with self._lock:
            if name in (SESSION, REQUEST):
                return self._session_file(name).read_bytes()
            if name in FILES:
                return self._result_file(name).read_bytes()
            identity, _, kind = name.partition('.')
            if kind not in ('xml', 'csv'):
                raise NotThere('file', name, 'the name of a file', 'load the page again')
            return self._chain_file(self._known(identity), kind)

    # ROS

    def topics(self) -> list[dict[str, str]]:
        """Return name and type of each topic with images."""
        return [] if self._connections.graph is None else self._connections.graph.topics()

    def add_topic_image(self, topic: str) -> dict[str, Any]:
        """Take the newest image of a topic as a photograph; return its id and the state."""
        image = self._graph().image(topic)
        octets = image.picture
        if not isinstance(octets, bytes):
            octets = cv2.imencode('.png', cv2.cvtColor(octets, cv2.COLOR_RGB2BGR),
                                  [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        with self._lock:
            if image.lens is not None:
                self.project.set_lens(image.lens, f'camera_info of {topic}')
            return self.add_photograph(octets, topic)

    def send(self, namespace: str) -> str:
        """Send all complete trials to a running calibrator; return what it says."""
        with self._lock:
            trials = self._complete()
        return self._graph().send(trials, namespace)

    # Time passes

    def tick(self) -> tuple[str, ...]:
        """Take what happened in the background; return what is new: `calibration`, `information`, `state`."""
        with self._lock:
            news = []
            _ = self._read  # a project that was opened now
            if self._fresh:
                self._prepare(self._fresh.pop(0))
            if self._calibrating.take():
                news.append('calibration' if self._calibrating.busy else 'state')
            if self._calibrating.revision != self._written:
                self._written = self._calibrating.revision
                news.append('state')
            if not self._calibrating.busy and self._information.take():
                news.append('information')
            return tuple(dict.fromkeys(news))

    def information(self) -> list[dict[str, Any]]:
        """Return what each trial tells, as far as that is known, with its number from 0."""
        with self._lock:
            return [{'trial': k, **found} for k in range(len(self._read.found.trials))
                    if (found := self._information.plain(_name(k))) is not None]

    def close(self) -> None:
        """End what goes on in the background; everything else is on the disk already."""
        with self._lock:
            self._information.close()
            self._calibrating.close()
            if self._connections.graph is not None:
                self._connections.graph.close()

    # Its own

    def _changed(self) -> dict[str, Any]:
        self._newest = None
        return self.state()

    @property
    def _read(self) -> _Read:
        """What the document means; after a change, it is read when somebody asks."""
        if self._newest is None:
            found = self._interpreter.interpret()
            trials = [None if one.trial is None else replace(one.trial, name=_name(k))
                      for k, one in enumerate(found.trials)]
            self._newest = _Read(found, tuple(trials), digest(tuple(trials), found.options))
            self._information.want([one for one in trials if one is not None], self._options({}))
        return self._newest

    def _prepare(self, identity: str) -> None:
        """Prepare a photograph, while the person looks at it, for the first click."""
        with suppress(InputError):
            self._interpreter.prepare(identity)

    def _complete(self) -> tuple[Trial, ...]:
        """Return the complete trials, as a session has them."""
        trials = self._read.found.usable
        if not trials:
            raise InputError('project', 'no complete trial', 'a start, a goal, and what the hands did',
                             'see what the trials lack')
        return trials

    def _write_session(self, given: Mapping[str, Any]) -> Path:
        path = self.project.folder / SESSION
        saving.write_session(path, self._complete(), self._options(given).flat())
        return path

    def _session_file(self, name: str) -> Path:
        """Write the session or request of the trials as they are now; return its path."""
        shown, found, given = self._calibrating.shown, self._calibrating.found, {}
        if shown is not None and found is not None and shown.digest == self._read.digest:
            given = dict(found.options)  # so that the same numbers follow
        if name == SESSION:
            return self._write_session(given)
        path = self.project.folder / REQUEST
        saving.write_request(path, self._complete(), self._options(given).flat())
        return path

    def _options(self, given: Mapping[str, Any]) -> Options:
        return Options.of({**self._read.found.options, **self._connections.options, **given})

    def _chain_file(self, identity: str, kind: str) -> bytes:
        chain = self._read.found.photographs[identity].chain
        if chain is None:
            raise InputError('point chain', 'a photograph without a scale or a line', 'both',
                             'give it a scale and click along the DLO first')
        return chain_csv(chain) if kind == 'csv' else chain_xml(chain)

    def _result_file(self, name: str) -> Path:
        if name not in self._calibrating.files:
            raise InputError(name, 'no such file yet', 'a result', 'calibrate first')
        return self._calibrating.folder / name

    def _known(self, identity: str) -> str:
        """
        Return an id that is in the document.

        :raises NotThere: for another one.
        """
        if identity not in self.project.document.by_id:
            raise NotThere('photograph', identity, 'the id of one of the project', 'load the page again')
        return identity

    def _graph(self) -> Graph:
        if self._connections.graph is None:
            raise InputError('ROS', 'no ROS 2 here', 'an installation of ROS 2 that is sourced',
                             'source it and start the page again')
        return self._connections.graph


def _name(number: int) -> str:
    return f'trial {number + 1}'


_ACTIONS = [{'kind': name, 'title': kind.title, 'text': kind.text,
             'fields': {one: field.described() for one, field in kind.fields.items()}}
            for name, kind in KINDS.items()]
