# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Record: one recorded message, its bytes to an object and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

from dlo_calibration.errors import InputError


@dataclass(frozen=True, slots=True)
class Record:
    """
    One recorded message.

    :param type: full name, ``package/msg/Type``.
    :param data: CDR bytes, with the encapsulation header.
    :param log_time: time of the recording [ns].
    :param stands_for: the input topic as which the user reads it; empty: its own name counts.
    """

    topic: str
    type: str
    data: bytes
    log_time: int
    stands_for: str = ''

    @property
    def name(self) -> str:
        """The last component of the topic's name, or the input topic for which it stands."""
        return self.stands_for or self.topic.rsplit('/', 1)[-1]

    @property
    def namespace(self) -> str:
        """The topic's name without its last component."""
        return self.topic.rpartition('/')[0]


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the message definitions of Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def decode(record: Record) -> Any:
    """
    Return the message of a record, as an object with the fields of its type.

    :raises InputError: where the bytes are not a message of that type.
    """
    try:
        return typestore().deserialize_cdr(record.data, record.type)
    except Exception as error:  # damaged bytes can raise anything
        raise InputError(
            f'{record.name} recorded at {record.log_time / 1e9:.3f} s',
            f'bytes that do not decode ({error!r})', f'a {record.type}',
            'leave that message out, or record the session again') from error


def encode(message: Any, message_type: str) -> bytes:
    """Return the CDR bytes of a message object of the library rosbags."""
    return bytes(typestore().serialize_cdr(message, message_type))
