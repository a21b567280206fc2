# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""YAML documents of strangers: read as text, lists and dicts, with limits and without aliases."""

from __future__ import annotations

from itertools import islice
from typing import Any, Iterator

from ruamel.yaml import YAML
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    Event,
    MappingStartEvent,
    ScalarEvent,
    SequenceStartEvent,
    StreamStartEvent,
)

MAXIMUM_EVENTS = 50_000  # of the parser: three seconds
MAXIMUM_DEPTH = 20  # rosbag2 needs 6


def read_first(octets: bytes) -> Any:
    """
    Return the first document in a file's content; every scalar in it is text.

    :raises Exception: of any kind, as damaged YAML can raise anything.
    """
    if b'\0' in octets:
        raise ValueError('no text')
    events = islice(YAML(typ='safe', pure=True).parse(octets.decode('utf-8')), MAXIMUM_EVENTS)
    return _plain(event for event in events if not isinstance(event, (StreamStartEvent, DocumentStartEvent)))


def _plain(events: Iterator[Event], depth: int = 0) -> Any:
    """
    Return the value that comes next: text, a list or a dict; None for the end of a list or a dict.

    :raises Exception: of any kind, where the events end, and for aliases, as a few make millions of values.
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
