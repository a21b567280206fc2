# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Source: a recorded session or an XML request, with the options to use on it, and its trials."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Callable, Mapping, Sequence

from dlo_calibration.calibration.choice import hand_warnings
from dlo_calibration.calibration.options import FileOptions, names_of, OBSERVATION, Options
from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.files.request import read_request, Request, request_manipulations, request_trials
from dlo_calibration.files.session import (
    read_session,
    Session,
    session_manipulations,
    session_trials,
    trial_records,
)
from dlo_calibration.model.named_actions import Manipulation
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.observation.plausibility import implausible_trials, repeated_trials

#: Options of which the largest value of several sessions counts.
LARGEST = ('slow_chain_error', 'slow_hand_error')


@dataclass(frozen=True)
class Selection:
    """
    A session or a request, and the selected parts of it.

    :param options: given by the user, by name; they override the recorded ones.
    :param namespace: of the topics; None: the session has only one.
    :param remap: the input topic as which each topic is read, by name.
    :param without: numbers of the trials to leave out, from 1.
    """

    path: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    namespace: str | None = None
    remap: Mapping[str, str] = field(default_factory=dict)
    without: tuple[int, ...] = ()


@dataclass(frozen=True)
class Source:
    """
    A session or a request, the options to use on it, and its trials.

    :param session: as recorded; for a request, a session without messages.
    :param warnings: about the file, one text each.
    :param refusal: why the scene of the file is not used; without it nothing is simulated.
    :param refusals: one text for each message that is not used, with the reason.
    :param notes: about messages that are unused as they should be.
    :param numbers: of the trials, from 1; trials that the user leaves out count, too.
    :param implausible: why the trials cannot be as described, see `plausibility`.
    :param evidence: of the hands in the trials.
    :param parts: several sessions of one DLO, of which this is made; empty: it is one.
    """

    selection: Selection
    session: Session
    request: Request | None
    options: Options
    warnings: tuple[str, ...]
    refusal: InputError | None
    trials: tuple[Trial, ...] = ()
    refusals: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()
    implausible: tuple[str, ...] = ()
    evidence: GripEvidence = GripEvidence(None, None, ())
    parts: tuple[Source, ...] = ()

    @property
    def trial_warnings(self) -> tuple[str, ...]:
        """Warnings about the trials: implausible and repeated ones, and errors of hands."""
        return (*self.implausible, *repeated_trials(self.trials), *map(str, self.evidence.losses),
                *hand_warnings(self.evidence, self.options))

    @property
    def path(self) -> Path:
        """Path of the session or the request."""
        return self.session.path

    @property
    def namespace(self) -> str | None:
        """Namespace that the user chose; None if the files of a result will not have it."""
        return None if self.session.remapped else self.selection.namespace

    @property
    def flags(self) -> list[str]:
        """The flags that select the same trials in the files of a result."""
        without = ','.join(map(str, self.selection.without))
        return [*(['--without', without] if without else []),
                *(['--namespace', self.namespace] if self.namespace else [])]

    def require_trials(self) -> Source:
        """
        Return this source if it can be simulated.

        :raises InputError: if it has no trial, or if a scene is refused.
        """
        if self.refusal is not None:
            raise self.refusal
        if not self.trials and self.request is not None:
            raise DloCalibrationError(f'{self.path}: {self.refusals[0]}')
        if not self.trials:
            raise InputError(f'session {self.path}', 'no complete trial',
                             'an initial_chain, an action and a goal_chain, in the order of their stamps',
                             'see what it contains with dlo-calibration info')
        return self


def is_request(path: Path) -> bool:
    """Tell whether a path names an XML request, not a session."""
    return path.suffix.lower() == '.xml'


def read_source(selection: Selection, warn: Callable[[str], None], of_result: FileOptions | None = None, *,
                any_topics: bool = False) -> Source:
    """
    Read a session or a request, with its recorded options, which those of the selection override.

    :param warn: called with each sentence that the user should read.
    :param of_result: options of a result; they override the recorded ones, except for the observation.
    :param any_topics: read a session without any topic of the calibrator, too.
    :raises InputError: if it cannot be read, an option has a bad value, or a trial to leave out is missing.
    """
    return _with_trials(_read(selection, warn, of_result, any_topics), warn)


def _with_trials(source: Source, warn: Callable[[str], None]) -> Source:
    """Return a source with its trials, those that are left out excepted."""
    options, without = source.options, source.selection.without
    notes: list[str] = []
    trials, refusals = session_trials(source.session, options, notes.append) if source.request is None else \
        request_trials(source.request, options)
    for text in (*source.warnings, *notes, *(refusals if trials or source.request is None else ())):
        warn(text)  # if no trial of a request can be used, `require_trials` says why
    numbers = _numbers(without, [trial.name for trial in trials], warn)
    used = tuple(trials[number - 1] for number in numbers)
    implausible = implausible_trials(used, options.table_top, bool(options.scene))
    source = replace(source, trials=used, refusals=refusals, notes=tuple(notes), numbers=numbers,
                     implausible=implausible, evidence=GripEvidence.of(used))
    for text in source.trial_warnings:
        warn(text)
    return source


def read_sources(selections: Sequence[Selection], warn: Callable[[str], None]) -> Source:
    """
    Read one or several sessions or requests of the same DLO; the trials of several become one session.

    The first gives the options of the search.

    :raises InputError: as `read_source` does; or if sessions were observed differently, or are too many.
    """
    if len(selections) == 1:
        return read_source(selections[0], warn)
    sources = [read_source(replace(selection, without=()), warn).require_trials() for selection in selections]
    first = sources[0]
    for other in sources[1:]:
        _require_same_observation(first, other)
    # As the files of the result hold them, so that these give the same numbers.
    records = trial_records([trial for source in sources for trial in source.trials])
    options = {**first.options.flat(), 'sessions': ' '.join(str(len(source.trials)) for source in sources),
               **{name: max(source.options.flat()[name] for source in sources) for name in LARGEST}}
    path = first.path.with_name('+'.join(source.path.name for source in sources))
    session = Session(path, records, records, FileOptions(options))
    merged = Source(replace(selections[0], path=path), session, None, Options.of(options), (), None,
                    parts=tuple(sources))
    return _with_trials(merged, warn)


def _require_same_observation(first: Source, other: Source) -> None:
    """
    Check that two sessions can be simulated with the same options.

    :raises InputError: if they were observed differently.
    """
    names = [name for name in names_of(OBSERVATION) if name not in ('sessions', *LARGEST)]
    for name in names:
        before, now = first.options.flat()[name], other.options.flat()[name]
        if before != now:
            raise InputError(f'session {other.path}', f'{name} {_text(now)}',
                             f'{_text(before)}, as in {first.path.name}',
                             f'give one value for both, e.g. --{name.replace("_", "-")}, or fit them alone')


def read_manipulations(selection: Selection, warn: Callable[[str], None], of_result: FileOptions
                       ) -> tuple[tuple[Manipulation, ...], Options]:
    """
    Read the manipulations of a session or a request, with or without goal chains, and the options to use.

    The parameters are those of `read_source`.

    :raises InputError: if it cannot be read, has no action, or an option has a bad value.
    """
    source = _read(selection, warn, of_result)
    if source.refusal is not None:
        raise source.refusal
    manipulations, refusals = session_manipulations(source.session, source.options) \
        if source.request is None else (request_manipulations(source.request, source.options), ())
    for text in (*source.warnings, *refusals, *(text for each in manipulations for text in each.warnings)):
        warn(text)
    if not manipulations:
        raise InputError(f'session {selection.path}', 'no action that can be simulated',
                         'an initial_chain, and an action after it',
                         'see what it contains with dlo-calibration info')
    numbers = _numbers(selection.without, [each.name for each in manipulations], warn)
    return tuple(manipulations[number - 1] for number in numbers), source.options


def _read(selection: Selection, warn: Callable[[str], None], of_result: FileOptions | None,
            any_topics: bool = False) -> Source:
    """Read a session or a request, without its trials; see `read_source`."""
    path = selection.path
    request = read_request(path) if is_request(path) else None
    if request is not None and selection.remap:
        raise InputError('--remap', 'a request, which has no topics', 'a recorded session', 'leave it out')
    session = read_session(path, selection.namespace, selection.remap, any_topics=any_topics) \
        if request is None else \
        Session(path, (), (), request.file_options, request.file_options.warnings)
    given = session.file_options or FileOptions()
    recorded, warnings, refusal = given.values, session.warnings, given.refusal
    if of_result:
        observed = {name: value for name, value in recorded.items() if name in names_of(OBSERVATION)}
        if 'scene' not in observed:
            refusal = refusal or of_result.refusal
        of_dlo = {name: value for name, value in of_result.values.items() if name != 'sessions'}
        recorded, warnings = {**of_dlo, **observed}, (*of_result.warnings, *warnings)
    options = Options.of({**recorded, **selection.options})
    for name in selection.options:
        value = options.flat()[name]
        if value != recorded.get(name, value):
            warn(f'{name}: {_text(value)} instead of {_text(recorded[name])}')
    return Source(selection, session, request, options,
                  tuple(text for text in warnings if text != str(refusal)),
                  None if 'scene' in selection.options else refusal)


def _numbers(without: Sequence[int], names: Sequence[str], warn: Callable[[str], None]) -> tuple[int, ...]:
    """Return the numbers of the trials that are not left out, with a warning for each of the others."""
    wrong = [number for number in without if not 1 <= number <= len(names)]
    if wrong:
        raise InputError('--without', f'trial {wrong[0]}', f'1 to {len(names)}' if names else
                         'nothing, as no trial is complete', 'see the numbers with dlo-calibration info')
    numbers = tuple(number for number in range(1, len(names) + 1) if number not in without)
    if without and not numbers:
        raise InputError('--without', 'all trials', f'at least one of the {len(names)} that stays',
                         'leave out fewer')
    for number in without:
        warn(f'{names[number - 1]} is left out')
    return numbers


def _text(value: Any) -> str:
    """Return the value of an option as typed by a user."""
    return ' '.join(value) if isinstance(value, list) else str(value)
