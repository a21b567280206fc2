# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Reading strangers' files: only regular files, and YAML within limits and without aliases."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
import stat
from typing import Any, Iterator

import yaml
from yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    Event,
    MappingStartEvent,
    ScalarEvent,
    SequenceStartEvent,
    StreamStartEvent,
)

from dlo_calibration.errors import InputError

MAXIMUM_EVENTS = 50_000  # of the parser: three seconds
MAXIMUM_DEPTH = 20  # rosbag2 needs 6


def require_file(path: Path, thing: str, expected: str) -> None:
    """
    Refuse a FIFO, a socket, a device and a folder: to read them could block or never end.

    :raises InputError: if `path` is no regular file.
    :raises OSError: if there is nothing, or it cannot be accessed.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        kinds = {stat.S_ISFIFO: 'a FIFO', stat.S_ISSOCK: 'a socket', stat.S_ISDIR: 'a folder',
                 stat.S_ISCHR: 'a device', stat.S_ISBLK: 'a device'}
        came = next((name for test, name in kinds.items() if test(mode)), 'something that is no file')
        raise InputError(thing, came, expected, 'name a file')


def read_octets(path: Path, thing: str, expected: str, most: int) -> bytes:
    """
    Return the content of a stranger's file, at most `most` + 1 bytes.

    :param thing: its name in errors.
    :raises InputError: if it cannot be read.
    """
    try:
        require_file(path, thing, expected)
        with path.open('rb') as stream:
            return stream.read(most + 1)
    except (OSError, ValueError) as error:
        raise InputError(thing, getattr(error, 'strerror', None) or str(error), expected,
                         'check the path') from error


def parse_yaml(octets: bytes) -> Any:
    """
    Return the first document of a YAML file; every scalar in it is text.

    :raises Exception: of any kind, because damaged YAML can raise anything.
    """
    if b'\0' in octets:
        raise ValueError('no text')
    loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)  # the fast one, where PyYAML was built with it
    events = islice(yaml.parse(octets.decode('utf-8'), loader), MAXIMUM_EVENTS)
    return _plain(event for event in events if not isinstance(event, (StreamStartEvent, DocumentStartEvent)))


def _plain(events: Iterator[Event], depth: int = 0) -> Any:
    """
    Return the next value: text, a list or a dict; None at the end of a list or a dict.

    :raises Exception: of any kind, if the events end; for an alias, because a few make millions of values.
    """
    event = next(events)
    if isinstance(event, AliasEvent) or depth > MAXIMUM_DEPTH:
        raise ValueError('an alias, or values nested too deep')
    if isinstance(event, ScalarEvent):
        return event.value
    if isinstance(event, SequenceStartEvent):
        return list(iter(lambda: _plain(events, depth + 1), None))
    if isinstance(event, MappingStartEvent):
        return {key: _plain(events, depth + 1) for key in iter(lambda: _plain(events, depth + 1), None)}
    return None
