# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Connections: what the page uses of the rooms after this one, which give it when it is opened."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Callable, Mapping, Protocol, Sequence

from dlo_calibration.calibration.engines import make_simulator, SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation.log import EvaluationLog
from dlo_calibration.model.trial import Trial
from dlo_calibration.writing import Attempts


class Begun(Protocol):
    """A calibration that has begun: what it calibrates on, and where its files belong."""

    trials: tuple[Trial, ...]
    options: Options
    log: EvaluationLog | None

    def write(self, result: CalibrationResult, should_stop: Callable[[], bool]) -> Attempts:
        """Write the files of the result, as far as possible."""

    def close(self, finished: bool) -> None:
        """Keep what was evaluated, so that the calibration can go on, or remove it as it is finished."""


class Begin(Protocol):
    """Begins calibrations."""

    def __call__(self, folder: Path, session: Path, tell: Callable[[str], None]) -> Begun:
        """
        Begin a calibration of a session.

        :param folder: of the result.
        :param session: the MCAP file.
        :param tell: called with each sentence that the user should read.
        :raises InputError: if it cannot begin.
        """


@dataclass(frozen=True)
class TopicImage:
    """
    The newest image of a ROS topic.

    :param picture: the content of a JPEG or PNG file, or (h, w, 3) red, green, blue, 0 to 255.
    :param lens: the content of a ROS camera calibration file; None: the camera does not tell.
    """

    picture: Any
    lens: bytes | None = None


class Graph(Protocol):
    """The ROS graph, as far as the page needs it."""

    def topics(self) -> list[dict[str, str]]:
        """Return name and type of each topic with images."""

    def image(self, topic: str) -> TopicImage:
        """
        Return the newest image of a topic.

        :raises InputError: if none comes.
        """

    def send(self, trials: Sequence[Trial], namespace: str) -> str:
        """
        Send trials to a calibrator, and return what it says.

        :param namespace: the full name of its node.
        :raises InputError: if no calibrator listens there.
        """

    def close(self) -> None:
        """Leave the graph."""


@dataclass(frozen=True)
class Connections:
    """
    What the page uses of the rooms after this one.

    :param begin: begins a calibration.
    :param sentences: returns a result in plain English.
    :param graph: the ROS graph; None: there is no ROS here.
    :param options: those of the command line, by name; they go before those of the project.
    """

    begin: Begin
    sentences: Callable[[CalibrationResult], list[str]]
    graph: Graph | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    make_simulator: SimulatorFactory = make_simulator
