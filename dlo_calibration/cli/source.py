# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Source: the input of a verb, a recorded session or an XML request, with its options and trials."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Sequence

from dlo_calibration.calibration.declaration import OBSERVATION
from dlo_calibration.calibration.file_options import FileOptions
from dlo_calibration.calibration.options import names_of, Options
from dlo_calibration.cli.options import add_options, given_options
from dlo_calibration.errors import DloCalibrationError, InputError, meant, one_of
from dlo_calibration.files.request import (
    read_request,
    Request,
    request_manipulations,
    request_trials,
)
from dlo_calibration.files.result import Description, read_result
from dlo_calibration.files.session import (
    Messages,
    read_session,
    Session,
    session_manipulations,
    session_trials,
)
from dlo_calibration.messages.codec import INPUT_TYPES
from dlo_calibration.model.manipulation import Manipulation
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.plausibility import implausible_trials


@dataclass(frozen=True)
class Source:
    """
    A session or a request, the options to use on it, and the trials in it.

    :param session: as recorded; for a request, a session without messages.
    :param refusals: one text for each message that is not used, with the reason.
    :param refusal: why the scene in a file is not among the options; without it, nothing is simulated.
    :param numbers: of the trials, from 1; those that the user leaves out have numbers, too.
    :param selection: the flags that select the same trials in the files of a result.
    :param doubts: what cannot be right about the trials, see `plausibility`.
    """

    session: Session
    options: Options
    trials: tuple[Trial, ...]
    refusals: tuple[str, ...]
    refusal: InputError | None = None
    numbers: tuple[int, ...] = ()
    selection: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def path(self) -> Path:
        """Path of the session or the request."""
        return self.session.path

    @property
    def is_request(self) -> bool:
        """Whether it is an XML request."""
        return is_request(self.path)

    def require_trials(self) -> Source:
        """
        Return this source if it can be simulated.

        :raises InputError: if it has no trial, or if a scene is refused.
        """
        if self.refusal is not None:
            raise self.refusal
        if not self.trials and self.is_request:
            raise DloCalibrationError(f'{self.path}: {self.refusals[0]}')
        if not self.trials:
            raise InputError(f'session {self.path}', 'no complete trial',
                             'an initial_chain, an action and a goal_chain, in the order of their stamps',
                             'see what it contains with dlo-calibration info')
        return self


def add_source(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    """Add the arguments that name a source, and the options to use on it."""
    parser.add_argument('session', metavar='SESSION', type=Path, nargs='?' if optional else None,
                        help='an MCAP file, the folder of a rosbag2 recording, or an XML request')
    add_without(parser)
    add_common_arguments(parser)
    add_options(parser)


def add_without(parser: argparse.ArgumentParser) -> None:
    """Add the flag that leaves trials out."""
    parser.add_argument('--without', metavar='K', action='append', default=[],
                        help='leave out the trial with this number, or several: 2,5')


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that every verb has."""
    parser.add_argument('--namespace', help='namespace of the topics, if a session has several')
    parser.add_argument('--remap', metavar='TOPIC:=NAME', action='append', default=[],
                        help=f'read a topic with another name as {one_of(INPUT_TYPES, "")}, '
                        'e.g. /trackdlo/results_pc:=goal_chain; may be repeated')
    parser.add_argument('--json', action='store_true', help='print one JSON document')


def read_result_file(chosen: argparse.Namespace) -> Description:
    """
    Read the RESULT.xml of a command line.

    :raises InputError: if it cannot be read; with a remedy of its own if it was exchanged with the session.
    """
    try:
        return read_result(chosen.result)
    except InputError as error:
        if is_request(chosen.session) and not is_request(chosen.result):
            raise InputError(error.thing, error.came, error.expected,
                             'name RESULT.xml and SESSION in the other order') from error
        raise


def is_request(path: Path) -> bool:
    """Tell whether a path names an XML request, not a session."""
    return path.suffix.lower() == '.xml'


def read_source(chosen: argparse.Namespace, note: Callable[[str], None],
                of_result: FileOptions | None = None, path: Path | None = None, *,
                any_topics: bool = False) -> Source:
    """
    Read a session or a request, with the options recorded in it; options given as flags override them.

    :param chosen: the parsed command line.
    :param note: called with each sentence that the user should read.
    :param of_result: options of a result; they override the recorded ones, except those of the observation.
    :param path: of the source; None: the one on the command line.
    :param any_topics: a session without any topic of the calibrator is read, too.
    :raises InputError: if it cannot be read, an option has a bad value, or a trial to leave out is not there.
    """
    opened = _open(chosen, note, of_result, chosen.session if path is None else path, any_topics)
    session, request, options = opened.session, opened.request, opened.options
    trials, refusals = session_trials(session, options) if request is None else \
        request_trials(request, options)
    for text in (*opened.problems, *(refusals if trials or request is None else ())):
        note(text)  # where no trial of a request can be used, `require_trials` says why
    out = left_out(chosen)
    kept = _kept(out, [trial.name for trial in trials], note)
    used = tuple(trials[number - 1] for number in kept)
    doubts = implausible_trials(used, options.table_height if options.table else None, bool(options.scene))
    for text in doubts:
        note(text)
    selection = ['--without', ','.join(map(str, out))] if out else []
    if chosen.namespace and not session.messages.remapped:
        selection += ['--namespace', chosen.namespace]
    return Source(session, options, used, refusals, opened.refusal, kept, tuple(selection), doubts)


def left_out(chosen: argparse.Namespace) -> tuple[int, ...]:
    """
    Return the numbers of the trials that a command line leaves out.

    :raises InputError: if they are no numbers.
    """
    words = [word for text in getattr(chosen, 'without', ()) for word in text.split(',')]
    for word in words:
        if not word.isdecimal() or len(word) > 9:
            raise InputError('--without', repr(word), 'numbers of trials, e.g. 2,5',
                             'see them with dlo-calibration info')
    return tuple(sorted(set(map(int, words))))


def _kept(out: Sequence[int], names: Sequence[str], note: Callable[[str], None]) -> tuple[int, ...]:
    """Return the numbers of the trials that are not left out; tell the names of the others."""
    wrong = [number for number in out if not 1 <= number <= len(names)]
    if wrong:
        raise InputError('--without', f'trial {wrong[0]}', f'1 to {len(names)}' if names else
                         'nothing, as no trial is complete', 'see the numbers with dlo-calibration info')
    kept = tuple(number for number in range(1, len(names) + 1) if number not in out)
    if out and not kept:
        raise InputError('--without', 'all trials', f'at least one of the {len(names)} that stays',
                         'leave out fewer')
    for number in out:
        note(f'{names[number - 1]} is left out')
    return kept


def _remap(chosen: argparse.Namespace) -> dict[str, str]:
    """Return the input topic as which each topic of a command line is read."""
    found: dict[str, str] = {}
    for text in getattr(chosen, 'remap', ()):
        topic, sign, kind = text.partition(':=')
        kind, topic = kind.removeprefix('~/'), f'/{topic.lstrip("/")}'
        if not sign or kind not in INPUT_TYPES:
            raise InputError('--remap', repr(text), f'TOPIC:=NAME, where NAME is {one_of(INPUT_TYPES, kind)}',
                             meant(kind, INPUT_TYPES, 'write it like /trackdlo/results_pc:=goal_chain'))
        if topic in found or kind in found.values():
            raise InputError('--remap', f'{topic if topic in found else kind} twice', 'each once',
                             'leave one of them out')
        found[topic] = kind
    return found


def read_manipulations(chosen: argparse.Namespace, note: Callable[[str], None],
                       of_result: FileOptions) -> tuple[tuple[Manipulation, ...], Options]:
    """
    Read what the hands do in a session or a request, with or without goal chains, and the options to use.

    The parameters are those of `read_source`.

    :raises InputError: if it cannot be read, has no action, or an option has a bad value.
    """
    opened = _open(chosen, note, of_result, chosen.session)
    out = left_out(chosen)
    if opened.refusal is not None:
        raise opened.refusal
    found, refusals = session_manipulations(opened.session, opened.options) if opened.request is None else \
        (request_manipulations(opened.request, opened.options), ())
    for text in (*opened.problems, *refusals, *(text for one in found for text in one.remarks)):
        note(text)
    if not found:
        raise InputError(f'session {chosen.session}', 'no action that can be simulated',
                         'an initial_chain, and an action after it',
                         'see what it contains with dlo-calibration info')
    kept = _kept(out, [one.name for one in found], note)
    return tuple(found[number - 1] for number in kept), opened.options


@dataclass(frozen=True)
class _Opened:
    """
    A session or a request that was read, and the options to use on it.

    :param session: for a request, a session without messages.
    :param problems: texts for the user.
    :param refusal: see `Source`; None where a flag names a scene.
    """

    session: Session
    request: Request | None
    options: Options
    problems: tuple[str, ...]
    refusal: InputError | None


def _open(chosen: argparse.Namespace, note: Callable[[str], None], of_result: FileOptions | None,
          path: Path, any_topics: bool = False) -> _Opened:
    """Read a session or a request, without its trials; see `read_source`."""
    request, remap = read_request(path) if is_request(path) else None, _remap(chosen)
    if request is not None and remap:
        raise InputError('--remap', 'a request, which has no topics', 'a recorded session', 'leave it out')
    session = read_session(path, chosen.namespace, remap, any_topics=any_topics) if request is None else \
        Session(path, Messages(), (), dict(request.options), request.problems, request.refusal)
    recorded, problems, refusal = session.recorded or {}, session.problems, session.refusal
    if of_result:
        observed = {name: value for name, value in recorded.items() if name in names_of(OBSERVATION)}
        if 'scene' not in observed:
            refusal = refusal or of_result.refusal
        recorded, problems = {**of_result.values, **observed}, (*of_result.problems, *problems)
    given = given_options(chosen)
    options = Options.of({**Options().flat(), **recorded, **given})
    for name in given:
        value = options.flat()[name]
        if value != recorded.get(name, value):
            note(f'{name}: {_text(value)} instead of {_text(recorded[name])}')
    return _Opened(session, request, options, tuple(text for text in problems if text != str(refusal)),
                   None if 'scene' in given else refusal)


def _text(value: Any) -> str:
    """Return the value of an option as a user types it."""
    return ' '.join(value) if isinstance(value, list) else str(value)
