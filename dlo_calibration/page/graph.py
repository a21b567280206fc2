# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The ROS graph, as far as the page needs it; the room `ros` implements it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, Sequence

from dlo_calibration.model.trial import Trial


@dataclass(frozen=True)
class TopicImage:
    """
    The newest image of a ROS topic.

    :param picture: the content of a JPEG or PNG file, or (h, w, 3) red, green, blue, 0 to 255.
    :param lens: the content of a ROS camera calibration file; None: the camera sends none.
    """

    picture: Any
    lens: bytes | None = None


class PageGraph(Protocol):
    """The ROS graph, as far as the page needs it."""

    def topics(self) -> list[dict[str, str]]:
        """Return name and type of each topic with images."""

    def image(self, topic: str) -> TopicImage:
        """
        Return the newest image of a topic.

        :raises InputError: if none arrives.
        """

    def send(self, trials: Sequence[Trial], namespace: str) -> str:
        """
        Send trials to a calibrator, and return its answer.

        :param namespace: the full name of its node.
        :raises InputError: if no calibrator listens there.
        """

    def close(self) -> None:
        """Leave the graph."""
