# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Interpretation: the readings and trials of a whole document."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Mapping

from dlo_calibration.calibration.options import Options
from dlo_calibration.capture.project import Project
from dlo_calibration.capture.readings import Reader, Reading
from dlo_calibration.capture.steps import held_after, Hold
from dlo_calibration.capture.trials import numbered, read_trial, ReadTrial
from dlo_calibration.model.parameters import BY_NAME, SCALE
from dlo_calibration.model.trial import Trial


@dataclass(frozen=True, eq=False)
class Interpretation:
    """
    What a document means.

    :param photographs: the reading of each photograph, by its id.
    :param trials: in the order of the document.
    :param mass: of the DLO [kg]; 0: unknown.
    """

    photographs: Mapping[str, Reading]
    trials: tuple[ReadTrial, ...]
    mass: float = 0.0

    @cached_property
    def usable(self) -> tuple[Trial, ...]:
        """The complete trials, named as a session that is read names them."""
        return numbered(self.trials)

    @property
    def diameter(self) -> float | None:
        """Diameter of the DLO [m]; None: neither given nor measured yet."""
        return next((one.thickness for one in self.photographs.values()), None)

    @property
    def options(self) -> dict[str, Any]:
        """
        The options that belong to these trials, by name.

        The table is the plane of the scale; the search for the radius begins at the DLO's own.
        """
        options: dict[str, Any] = {'table': True, 'table_height': 0.0, 'mass': self.mass}
        if self.diameter is not None:
            value = BY_NAME['self_collision'].value(self.diameter / 2)
            options['self_collision'] = min(max(value, 0.0), SCALE)
        return Options.of(options).flat()

    def plain(self) -> dict[str, Any]:
        """Return what the page draws, as plain values."""
        return {'photographs': {one: reading.plain for one, reading in self.photographs.items()},
                'trials': [trial.plain for trial in self.trials]}


class Interpreter:
    """
    Interprets the document of a project; it belongs to one thread.

    What did not change since the last time is not computed again.
    """

    def __init__(self, project: Project) -> None:
        self._project = project
        self._reader = Reader(project)
        self._known: dict[int, tuple[tuple[object, ...], ReadTrial]] = {}

    def prepare(self, one: str) -> None:
        """
        Prepare what the traces of a photograph, given by its id, need, so that the first click is not slower.

        :raises InputError: where it cannot be read.
        """
        self._reader.prepare(one)

    def interpret(self) -> Interpretation:
        """Return what the present document means."""
        document = self._project.document
        readings = self._reader.readings(document)
        known, self._known = self._known, {}
        before: tuple[str | None, tuple[Hold, ...]] = (None, ())  # the last goal, and who holds the DLO there
        for number, entry in enumerate(document.trials, start=1):
            held = before[1] if before[0] == entry.start else ()
            key = entry, held, *(readings[one] for one in entry.photographs)
            same = number in known and known[number][0] == key
            self._known[number] = known[number] if same else (
                key, read_trial(number, entry, readings, held))
            before = entry.goal, held_after(entry.steps, held)
        trials = tuple(trial for _, trial in self._known.values())
        return Interpretation(readings, trials, document.dlo.mass)
