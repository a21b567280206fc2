# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Session: the trials of a recorded session.

It reads sessions that `recording` wrote, also where the process was killed, and
other bags that contain the topics of the calibrator.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
import os
from pathlib import Path
import sys
from typing import Any, Callable, Iterable, Mapping

from dlo_calibration.calibration.options import file_options, FileOptions, Options
from dlo_calibration.errors import DEFECT, InputError, one_of, safe_line, suggestion
from dlo_calibration.files.bag_reader import read_bag
from dlo_calibration.files.record import decode, encode, Record
from dlo_calibration.messages.codec import (
    bag_types,
    built,
    GOAL,
    INPUT_TYPES,
    InputMessage,
    Key,
    read,
    repeats,
    TRIAL_TYPES,
    WRENCH,
)
from dlo_calibration.messages.collector import StampOrder, TrialCollector, went_back
from dlo_calibration.messages.encoder import trial_messages
from dlo_calibration.messages.refusals import counted
from dlo_calibration.model.named_actions import Manipulation
from dlo_calibration.model.trial import Trial


@dataclass(frozen=True)
class Session:
    """
    The content of a recorded session.

    :param inputs: messages of the input topics that decode, in log order: those that the last calibration
        of the session used, or, where none was started, all since the last reset.
    :param records: all recorded messages of the calibrator's topics, also outputs, in log order.
    :param file_options: the last recorded options; None: there were none.
    :param warnings: those of the options, and one text for each defect that did not prevent reading.
    :param counts: number of recorded messages by topic, also of those that other programs use.
    :param duration: time from the first to the last of these [s].
    :param frames: the frame_ids of chains and actions in `inputs`, sorted.
    :param others: topics that are neither inputs nor outputs of the calibrator, and their types.
    """

    path: Path
    inputs: tuple[Record, ...]
    records: tuple[Record, ...]
    file_options: FileOptions | None = None
    warnings: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    duration: float = 0.0
    frames: tuple[str, ...] = ()
    others: Mapping[str, str] = field(default_factory=dict)

    @property
    def messages(self) -> list[tuple[str, Any]]:
        """The (kind, message) pairs of `inputs`, which take several times the memory of their records."""
        return [(record.name, decode(record)) for record in self.inputs]

    @property
    def remapped(self) -> bool:
        """Whether topics are read as others."""
        return any(record.stands_for for record in self.inputs)

    @property
    def renamed(self) -> tuple[Record, ...]:
        """The inputs, those of remapped topics under names that need no remapping."""
        home = next((record.namespace for record in self.inputs if not record.stands_for), '/calibrator')
        return tuple(replace(record, topic=f'{home}/{record.name}', stands_for='')
                     for record in self.inputs)

    @property
    def options(self) -> Options:
        """
        The recorded options; the defaults where none were recorded.

        :raises InputError: where the recorded scene cannot be used.
        """
        return (self.file_options or FileOptions()).options()

    @cached_property
    def trials(self) -> tuple[Trial, ...]:
        """The complete trials with the recorded options; `session_trials` also returns the refusals."""
        return session_trials(self, Options.of((self.file_options or FileOptions()).values))[0]

    def outputs(self, name: str) -> tuple[Any, ...]:
        """
        Return the messages in log order of all topics that end in `name`, e.g. ``result``.

        :raises InputError: where a message does not decode.
        """
        return tuple(decode(record) for record in self.records if record.name == name)


def trial_records(trials: Iterable[Trial], frame_id: str = 'world') -> tuple[Record, ...]:
    """Return the records of a session in which a robot does the given trials; see `trial_messages`."""
    return message_records(trial_messages(tuple(trials), frame_id))


def message_records(messages: Iterable[InputMessage]) -> tuple[Record, ...]:
    """Return the records of a session with the given messages."""
    types, records = bag_types(), []
    for message in messages:
        name = INPUT_TYPES[message.kind]
        octets = encode(built(types, message), name)
        records.append(Record(f'/calibrator/{message.kind}', name, octets, message.stamp))
    return tuple(records)


def session_trials(session: Session, options: Options, note: Callable[[str], object] = lambda text: None
                   ) -> tuple[tuple[Trial, ...], tuple[str, ...]]:
    """
    Return the complete trials of a session, and the reasons why messages are not used, each once.

    :param note: called with each sentence about early messages, which are not used and not refused.
    """
    clocks, refusals = _by_clock(session)
    trials: list[Trial] = []
    early: list[str] = []
    for messages in clocks:
        collector, refused = _collected(messages, options)
        trials += collector.trials
        early += collector.take_early()
        refusals += [text for _, text in refused]
        refusals += map(str, (*collector.refusals, *collector.loose_end, *collector.force_problems))
    for text in counted(early):
        note(text)
    named = (replace(trial, name=f'trial {k}') for k, trial in enumerate(trials, start=1))
    return _in_sessions(tuple(named), options), counted(refusals)


def _in_sessions(trials: tuple[Trial, ...], options: Options) -> tuple[Trial, ...]:
    """
    Return trials with the numbers of their sessions.

    :raises InputError: if there are other trials than the options say.
    """
    counts = options.trials_of_sessions
    if not counts or not trials:
        return trials
    if sum(counts) != len(trials):
        raise InputError('parameter sessions', f'{options.sessions}, which are {sum(counts)} trials',
                         f'numbers that add up to {len(trials)}, the trials that there are', 'correct it')
    sessions = [session for session, count in enumerate(counts, start=1) for _ in range(count)]
    return tuple(replace(trial, session=session)
                 for trial, session in zip(trials, sessions, strict=True))


def session_manipulations(session: Session,
                          options: Options) -> tuple[tuple[Manipulation, ...], tuple[str, ...]]:
    """Return the manipulations of a session, with or without goal chains, and why messages are not used."""
    clocks, refusals = _by_clock(session)
    manipulations: list[Manipulation] = []
    for messages in clocks:
        collector, refused = _collected(messages, options)
        of_clock, errors = collector.manipulations()
        manipulations += of_clock
        replaced = set(map(str, collector.refusals))  # by `errors`, which hold without goal chains
        refusals += [text for kind, text in refused if kind != GOAL and text not in replaced]
        refusals += map(str, errors)
    named = (replace(manipulation, name=f'trial {k}')
             for k, manipulation in enumerate(manipulations, start=1))
    return tuple(named), counted(refusals)


def _by_clock(session: Session) -> tuple[list[list[InputMessage]], list[str]]:
    """Return the messages before and after each jump of the clock, and why others are not used."""
    order, refusals = StampOrder(), []
    clocks: list[list[InputMessage]] = [[]]
    for record in session.inputs:
        try:
            content = read(record.name, decode(record))
            order.check(content)
        except InputError as error:
            refusals.append(str(error))
            continue
        except Exception as error:  # a defect of this package must not cost the other messages
            refusals.append(f'{record.name}: could not be used ({error!r}); {DEFECT}')
            continue
        if order.clock_went_back(content):
            refusals.append(f'{went_back(order.newest, content.stamp)}: '
                            'later messages make trials of their own')
            order = StampOrder(order)
            clocks.append([])
        order.add(content)
        clocks[-1].append(content)
    earlier: dict[Key, InputMessage] = {}
    for k, messages in enumerate(clocks):
        fresh = [message for message in messages
                 if message.key not in earlier or not repeats(message, earlier[message.key])]
        if len(fresh) < len(messages):
            refusals.append(f'{len(messages) - len(fresh)} message(s) after the clock went back repeat '
                            'earlier ones: a recording that was played again is no second observation')
        earlier |= {message.key: message for message in messages}
        clocks[k] = fresh
    return clocks, refusals


def _collected(messages: Iterable[InputMessage],
               options: Options) -> tuple[TrialCollector, list[tuple[str, str]]]:
    """Collect the messages of one clock; also return the kind of each refused message, and why."""
    collector = TrialCollector(options)
    refusals = []
    # The trials do not depend on the order of arrival.
    for message in sorted(messages, key=lambda message: message.stamp):
        try:
            collector.add(message)
        except InputError as error:
            refusals.append((message.kind, str(error)))
        except Exception as error:  # a defect of this package must not cost the other messages
            refusals.append((message.kind, f'{message}: could not be used ({error!r}); {DEFECT}'))
        refusals += [(message.kind, str(refusal)) for refusal in collector.take_refusals()]
    return collector, refusals


def read_session(path: str | Path, namespace: str | None = None, remap: Mapping[str, str] | None = None,
                 *, any_topics: bool = False) -> Session:
    """
    Read an MCAP file, a rosbag2 folder, or a .db3 file.

    Input topics are recognised by the last part of their name and by their type.

    :param namespace: of the input topics, e.g. ``/calibrator``; needed where several namespaces have them.
    :param remap: the input topic as which another topic is read, e.g. ``{'/trackdlo/results_pc':
        'goal_chain'}``; no other topic is then read as this one.
    :param any_topics: read a session without any input topic, too.
    :raises InputError: where the session cannot be read, or has none of the input topics.
    """
    path, remap = Path(path), remap or {}
    bag = read_bag(path, remap)
    records = tuple(sorted(bag.records, key=lambda record: record.log_time))
    recorded, warnings = bag.options(), bag.warnings
    seen = sorted(bag.counts)
    _check_remap(remap, dict(seen))
    try:
        topics = _input_topics(path, seen, namespace, remap, warnings)
    except InputError as error:
        if not any_topics or not seen or any(TRIAL_TYPES.get(topic.rsplit('/', 1)[-1]) == kind
                                             for topic, kind in seen):
            raise
        topics = frozenset()
        warnings.append(f'no topic is one of {", ".join(TRIAL_TYPES)}; {error.remedy}')
    inputs = [record for record in records
              if record.topic in topics and record.type == INPUT_TYPES[record.name]]
    usable, frames = _checked(bag.used(inputs), warnings)
    warnings += bag.dropped()
    counts: Counter[str] = Counter()
    for (topic, _), count in bag.counts.items():
        counts[topic] += count
    options = None if recorded is None else file_options(recorded, path if path.is_dir() else path.parent)
    if options is not None:
        warnings += options.warnings
    return Session(path, usable, records, options, counted(map(safe_line, warnings)), counts,
                   bag.duration, frames,
                   {topic: kind for topic, kind in seen if not bag.uses(topic, kind)})


def _checked(records: Iterable[Record],
             warnings: list[str]) -> tuple[tuple[Record, ...], tuple[str, ...]]:
    """Return the messages that decode, and their frame_ids; report the others, once for each topic."""
    good, frames = [], set()
    bad: dict[str, InputError] = {}
    more: Counter[str] = Counter()
    for record in records:
        try:
            header = decode(record).header
        except InputError as error:
            more[record.topic] += record.topic in bad
            bad.setdefault(record.topic, error)
            continue
        good.append(record)
        if record.name != WRENCH:  # which names a hand
            frames.add(header.frame_id)
    warnings += [f'{error}; and {more[topic]} more of {topic}' if more[topic] else str(error)
                 for topic, error in bad.items()]
    return tuple(good), tuple(sorted(frames))


def _check_remap(remap: Mapping[str, str], seen: Mapping[str, str]) -> None:
    """Refuse topics that are not in a session, or cannot be what they are remapped to."""
    for topic, kind in remap.items():
        if topic not in seen:
            raise InputError(f'topic {topic} to read as {kind}', 'no such topic', one_of(seen, topic),
                             suggestion(topic, seen,
                                        'correct the name; dlo-calibration info lists the topics'))
        if seen[topic] != INPUT_TYPES[kind]:
            raise InputError(f'topic {topic} to read as {kind}', f'a {seen[topic]}',
                             f'a {INPUT_TYPES[kind]}', 'name another topic; dlo-calibration info lists them')


def _input_topics(path: Path, seen: Iterable[tuple[str, str]], namespace: str | None,
                  remap: Mapping[str, str], warnings: list[str]) -> frozenset[str]:
    """Return the topics to read, at most one for each kind of message; `seen` has topics and their types."""
    candidates: dict[str, list[Record]] = {kind: [] for kind in INPUT_TYPES if kind not in remap.values()}
    for record in (Record(topic, kind, b'', 0) for topic, kind in seen):
        if record.topic in remap:
            continue
        if record.name in remap.values():
            warnings.append(f'topic {record.topic} is left out, as another one is read as {record.name}')
            continue
        if record.type == INPUT_TYPES.get(record.name):
            if record.name == WRENCH or namespace is None or \
                    record.namespace.strip('/') == namespace.strip('/'):
                candidates[record.name].append(record)
        elif record.name in INPUT_TYPES:
            warnings.append(f'topic {record.topic} is left out: it is a {record.type}, '
                            f'not a {INPUT_TYPES[record.name]}')
    forces = candidates.pop(WRENCH, [])  # each names its hand, so that any number of them can be read
    if not (remap or any(candidates.values())):
        held = ', '.join(sorted(f'{topic} ({kind})' for topic, kind in seen)) or 'no messages'
        raise InputError(
            f'session {path}', f'{held} ({warnings[-1]})' if warnings else held,
            'at least one of ' + ', '.join(f'{kind} ({text})' for kind, text in TRIAL_TYPES.items())
            + ('' if namespace is None else f' in namespace {namespace}'),
            'record these topics, or name others with --remap TOPIC:=goal_chain' if namespace is None else
            'correct the namespace')
    if any(len(choice) > 1 for choice in candidates.values()):
        spaces = sorted({record.namespace or '/' for choice in candidates.values() for record in choice})
        complete = [space for space in spaces if all(
            space.rstrip('/') in {record.namespace for record in choice} for choice in candidates.values())]
        if len(complete) != 1:
            raise InputError(
                f'session {path}', f'input topics in the namespaces {", ".join(spaces)}',
                'one namespace with the three input topics', 'name the namespace to read, or record only one')
        warnings.append(f'topics outside the namespace {complete[0]} are left out')
        candidates = {kind: [r for r in choice if r.namespace == complete[0].rstrip('/')]
                      for kind, choice in candidates.items()}
    chosen = (*forces, *(record for choice in candidates.values() for record in choice))
    return frozenset([*remap, *(record.topic for record in chosen)])


def samples() -> Path:
    """Return the folder of the sample sessions, in the sources or where the package is installed."""
    sources = Path(__file__).resolve().parents[2] / 'msg_samples'
    shared = Path('share') / 'dlo_calibration' / 'msg_samples'
    prefixes = [sys.prefix, *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    for folder in (sources, *(Path(prefix) / shared for prefix in prefixes if prefix)):
        if folder.is_dir():
            return folder
    raise InputError('samples', 'no folder msg_samples', f'{sources} or $AMENT_PREFIX_PATH/{shared}',
                     'install the package with its samples, or name a session')
