# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Source: what a verb works on, a recorded session or an XML request, with its options and trials."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Mapping

from dlo_calibration.calibration.options import names_of, OBSERVATION, Options
from dlo_calibration.cli.options import add_options, given_options
from dlo_calibration.errors import InputError
from dlo_calibration.files.request import read_request, request_trials
from dlo_calibration.files.session import read_session, Session, session_trials
from dlo_calibration.model.trial import Trial


@dataclass(frozen=True)
class Source:
    """
    A session or a request, the options to use on it, and the trials in it.

    :param session: as recorded; of a request, one without messages.
    :param refusals: why messages are not used, one text each.
    """

    session: Session
    options: Options
    trials: tuple[Trial, ...]
    refusals: tuple[str, ...]

    @property
    def path(self) -> Path:
        """Of the session or the request."""
        return self.session.path

    @property
    def is_request(self) -> bool:
        """Tell whether it is an XML request."""
        return is_request(self.path)

    def require_trials(self) -> Source:
        """
        Return this source, which has a trial.

        :raises InputError: where it has none.
        """
        if not self.trials:
            raise InputError(f'session {self.path}', 'no complete trial',
                             'an initial_chain, an action and a goal_chain, in the order of their stamps',
                             'see what is in it with dlo-calibration info')
        return self


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add the words that name a source, and the options to use on it."""
    parser.add_argument('session', metavar='SESSION', type=Path,
                        help='an MCAP file, the folder of a rosbag2 recording, or an XML request')
    parser.add_argument('--namespace', help='of the topics, where the session holds several')
    parser.add_argument('--json', action='store_true', help='print one JSON document')
    add_options(parser)


def is_request(path: Path) -> bool:
    """Tell whether a path names an XML request, not a session."""
    return path.suffix.lower() == '.xml'


def read_source(chosen: argparse.Namespace, note: Callable[[str], None],
                of_result: Mapping[str, Any] | None = None, path: Path | None = None) -> Source:
    """
    Read a session or a request, with the options recorded in it; options given as flags come first.

    :param chosen: the parsed words.
    :param note: called with what the user should know of it, one sentence each.
    :param of_result: options of a result, which come before the recorded ones, save those of the observation.
    :param path: of the source; None: the one that the words name.
    """
    path = chosen.session if path is None else path
    request = read_request(path) if is_request(path) else None
    session = read_session(path, chosen.namespace) if request is None else \
        Session(path, (), (), dict(request.options), ())
    recorded = session.recorded or {}
    if of_result:
        observed = names_of(OBSERVATION)
        recorded = {**of_result, **{name: value for name, value in recorded.items() if name in observed}}
    given = given_options(chosen)
    options = Options.of({**Options().flat(), **recorded, **given})
    for name in given:
        value = options.flat()[name]
        if value != recorded.get(name, value):
            note(f'{name}: {_text(value)} instead of {_text(recorded[name])}')
    trials, refusals = session_trials(session, options) if request is None else \
        request_trials(request, options)
    for text in (*session.problems, *refusals):
        note(text)
    return Source(session, options, trials, refusals)


def _text(value: Any) -> str:
    """Return the value of an option as a user writes it."""
    return ' '.join(value) if isinstance(value, list) else str(value)
