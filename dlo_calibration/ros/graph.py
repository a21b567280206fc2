# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Graph: what a session needs from its node."""

from __future__ import annotations

from typing import Any, Protocol

from dlo_calibration.calibration.options import Options


class Graph(Protocol):
    """What a session needs from its node."""

    def options(self) -> Options:
        """Return the options in force."""

    def stamp(self) -> int:
        """Return the time for the header of a message [ns]."""

    def topic(self, name: str) -> str:
        """Return the full name of one of the node's topics."""

    def decode(self, kind: str, octets: bytes) -> Any:
        """Return the message that came on an input topic; damaged bytes may raise any exception."""

    def encode(self, name: str, message: Any) -> bytes:
        """Return the CDR bytes of a message for an output topic."""

    def publish(self, name: str, octets: bytes) -> None:
        """Publish bytes on an output topic."""

    def hear_waiting(self) -> None:
        """Pass messages that wait to the session, for a moment only."""

    def info(self, text: str) -> None:
        """Log a text."""

    def warn(self, text: str) -> None:
        """Log a warning."""

    def error(self, text: str) -> None:
        """Log an error."""
