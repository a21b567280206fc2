# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measurement: the scale, the line of the DLO, and its axis in metres, as measured in a photograph."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
import time
from typing import Any, Callable, Hashable, Mapping, Sequence, TypeVar, Union

import numpy as np

from dlo_calibration.capture.document import BoardScale, Document, PhotographEntry, PointsScale
from dlo_calibration.capture.project import Project
from dlo_calibration.errors import DEFECT, InputError
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.vision.axis import Axis, axis_of, measured_diameter
from dlo_calibration.vision.board import find_board
from dlo_calibration.vision.camera import Lens
from dlo_calibration.vision.middle_line import along_line, arc_lengths
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.scale import grid, Scale
from dlo_calibration.vision.tracer import Trace, Tracer

ANSWER_REACH = 3.0  # widths of the DLO between a crossing and the pixel of the answer that belongs to it
LATTICE = 25, 19  # columns and rows of pixels whose places on the table the page knows
TRACERS = 3  # kept in memory, each with what it prepared of its photograph

Value = TypeVar('Value')


@dataclass(frozen=True, eq=False)
class Marked:
    """
    A scale and the points that it was made of.

    :param pixels: (k, 2) [px].
    :param table: (k, 2) [m].
    """

    scale: Scale
    pixels: Floats
    table: Floats


@dataclass(frozen=True, eq=False)
class Measurement:
    """
    What was measured in a photograph.

    :param problem: why the photograph cannot be read; likewise `scale_problem` and `trace_problem`.
    :param marked: the points of its own scale; None where it has another's.
    :param seconds: that tracing took.
    :param above: index of a crossing -> whether its first strand is above, as answered or else suggested.
    :param answered: indices of the crossings with an answer.
    :param diameter: of the DLO, as measured in this photograph [m]; `thickness`: as it is used for all.
    :param axis: of the DLO, if it lies on the table; `axis_problem`: why it has none.
    :param count: number of points of the chain.
    """

    entry: PhotographEntry
    size: tuple[int, int] = (0, 0)
    problem: str | None = None
    scale: Scale | None = None
    scale_problem: str | None = None
    marked: Marked | None = None
    trace: Trace | None = None
    trace_problem: str | None = None
    seconds: float = 0.0
    above: Mapping[int, bool] = field(default_factory=dict)
    answered: frozenset[int] = frozenset()
    diameter: float | None = None
    thickness: float | None = None
    axis: Axis | None = None
    axis_problem: str | None = None
    count: int = 21

    @cached_property
    def chain(self) -> Chain | None:
        """The chain of evenly spaced points; None without a scale or a line."""
        return None if self.axis is None else self.axis.chain(np.linspace(0.0, 1.0, self.count))

    @cached_property
    def plain(self) -> dict[str, Any]:
        """What the page draws, as plain values."""
        return {'width': self.size[0], 'height': self.size[1], 'problem': self.problem,
                'scale': self._plain_scale(), 'scale_problem': self.scale_problem,
                'trace': self._plain_trace(), 'trace_problem': self.trace_problem}

    def _plain_scale(self) -> dict[str, Any] | None:
        if self.scale is None:
            return None
        own = self.marked
        return {'residual': self.scale.residual, 'residuals': numbers(self.scale.residuals, 6),
                'notes': list(self.scale.notes), 'board': None,
                'grid': [{'pixels': numbers(line, 1), 'label': label}
                         for label, line in grid(self.scale)],
                'pixels': [] if own is None else numbers(own.pixels),
                'table': [] if own is None else numbers(own.table, 6),
                'lattice': _lattice(self.scale)}

    def _plain_trace(self) -> dict[str, Any] | None:
        trace, axis = self.trace, self.axis
        if trace is None:
            return None
        crossings = [{'pixel': numbers(np.array(crossing.pixel)), 'first_above': self.above.get(k),
                      'answered': k in self.answered, 'suggested': crossing.first_above}
                     for k, crossing in enumerate(trace.crossings)]
        chain = None
        if axis is not None:
            along = arc_lengths(trace.pixels)
            places = np.interp(np.linspace(0.0, axis.length, self.count), axis.along, along)
            chain = numbers(along_line(trace.pixels, along, places))
        return {'pixels': numbers(trace.pixels), 'sure': trace.sure.tolist(), 'width': trace.width,
                'crossings': crossings, 'length': None if axis is None else axis.length,
                'diameter': self.diameter, 'seconds': self.seconds, 'chain': chain}


def _lattice(scale: Scale) -> dict[str, Any]:
    """Return columns and rows of pixels, and where on the table each row of their crossings is [m]."""
    width, height = scale.size
    columns, rows = np.linspace(0, width - 1, LATTICE[0]), np.linspace(0, height - 1, LATTICE[1])
    table = scale.points(np.stack(np.meshgrid(columns, rows), axis=-1))[:, :2].reshape(*LATTICE[::-1], 2)
    shown = ~np.isnan(table).any(axis=(1, 2))  # rows below the horizon
    return {'columns': numbers(columns, 2), 'rows': numbers(rows[shown], 2),
            'table': numbers(table[shown], 6)}


class Measurer:
    """
    Measures the photographs of a project, and remembers what did not change, so that a click costs one trace.

    It belongs to one thread.  `tracer` returns the tracer of a photograph, given by its id.
    """

    def __init__(self, project: Project) -> None:
        self._project = project
        self._document = project.document  # as it is while it is measured
        self.tracer = lru_cache(TRACERS)(lambda photograph: Tracer(project.photograph(photograph).pixels))
        self._known: dict[tuple[str, str], tuple[Hashable, Any]] = {}

    def measure(self, document: Document) -> dict[str, Measurement]:
        """Return what is measured in each photograph of a document, by its id."""
        self._document = document
        self._known = {key: value for key, value in self._known.items() if key[1] in document.by_id}
        measured = {entry.id: self._measured(entry) for entry in document.photographs}
        sides = {side for trial in document.trials for side in (trial.start_side, trial.goal_side)}
        diameter = document.dlo.diameter or _median_diameter(
            [measurement for name, measurement in measured.items() if name not in sides])
        return {name: self._with_axis(measurement, diameter) for name, measurement in measured.items()}

    def _attempt(self, what: str, photograph: str, key: Hashable,
                 make: Callable[[], Value]) -> Union[Value, InputError]:
        """Return what `make` returns or refuses; it is called only where the key changed."""
        known = self._known.get((what, photograph))
        if known is not None and known[0] == key:
            return known[1]  # type: ignore[no-any-return]
        value: Union[Value, InputError]
        try:
            value = make()
        except InputError as error:
            value = error
        except Exception as error:  # a defect of this package must not cost the other photographs
            value = InputError(f'{what} of the photograph', repr(error), 'something that can be used', DEFECT)
        self._known[what, photograph] = key, value
        return value

    def _measured(self, entry: PhotographEntry) -> Measurement:
        """Return the measurement of a photograph, without the axis."""
        size = self._attempt('size', entry.id, (), lambda: self._project.photograph(entry.id).size)
        if isinstance(size, InputError):
            return Measurement(entry, problem=str(size))
        measurement = Measurement(entry, size, count=self._document.dlo.points)
        owner = self._document.scale_of(entry)
        marked = self._scale(owner, entry, size)
        if isinstance(marked, InputError):
            measurement = replace(measurement, scale_problem=str(marked))
        elif marked is not None:
            measurement = replace(measurement, scale=marked.scale, marked=marked if owner is entry else None)
        if len(entry.clicks) < 2:
            return measurement
        traced = self._attempt('trace', entry.id, entry.clicks, partial(self._traced, entry))
        if isinstance(traced, InputError):
            return replace(measurement, trace_problem=str(traced))
        trace, seconds = traced
        above, answered = answers(entry, trace)
        diameter = None
        if measurement.scale is not None:
            diameter = self._attempt('diameter', entry.id, (trace, measurement.scale), partial(
                measured_diameter, trace, measurement.scale))
        return replace(measurement, trace=trace, seconds=seconds, above=above, answered=answered,
                       diameter=None if isinstance(diameter, InputError) else diameter)

    def _scale(self, owner: PhotographEntry, entry: PhotographEntry,
               size: tuple[int, int]) -> Union[Marked, InputError, None]:
        """Return the scale that a photograph has, its own or that of another one."""
        if owner.scale is None:
            return None
        lens = self._project.lens
        marked = self._attempt('scale', owner.id, (owner.scale, lens), lambda: self._marked(owner, lens))
        if isinstance(marked, Marked) and marked.scale.size != size:
            return InputError(f'scale of {entry.name}', f'that of {owner.name}, which has another size',
                              'one of the same camera', 'give this photograph a scale of its own')
        return marked

    def _marked(self, owner: PhotographEntry, lens: Lens | None) -> Marked:
        photograph = self._project.photograph(owner.id)
        if isinstance(owner.scale, BoardScale):
            pixels, table = find_board(photograph.pixels, printed=owner.scale.ruler)
        else:
            assert isinstance(owner.scale, PointsScale)
            pixels, table = (np.array([getattr(point, name) for point in owner.scale.points]).reshape(-1, 2)
                             for name in ('pixel', 'table'))
        scale = scale_from_points(pixels, table, photograph.size, lens, photograph.focal_length)
        return Marked(scale, pixels, table)

    def _traced(self, entry: PhotographEntry) -> tuple[Trace, float]:
        begin = time.perf_counter()
        trace = self.tracer(entry.id).trace(np.array(entry.clicks))
        return trace, time.perf_counter() - begin

    def _with_axis(self, measurement: Measurement, diameter: float | None) -> Measurement:
        """Return a measurement with the axis; the same object as long as nothing changed."""
        trace, scale, photograph = measurement.trace, measurement.scale, measurement.entry.id
        axis: Union[Axis, InputError, None] = None
        if trace is not None and scale is not None and diameter is not None:
            key = trace, scale, diameter, measurement.count, tuple(sorted(measurement.above.items()))
            axis = self._attempt('axis', photograph, key, lambda: axis_of(
                trace, scale, diameter, measurement.count, measurement.above))
        problem, axis = (str(axis), None) if isinstance(axis, InputError) else (None, axis)
        completed = replace(measurement, thickness=diameter, axis=axis, axis_problem=problem)
        inputs = measurement.entry, scale, trace, axis, measurement.scale_problem, measurement.count, diameter
        return self._attempt('result', photograph, inputs, lambda: completed)  # type: ignore[return-value]


def _median_diameter(measurements: Sequence[Measurement]) -> float | None:
    """Return the diameter as measured in most photographs, to a tenth of a millimetre [m]."""
    diameters = [one.diameter for one in measurements if one.diameter is not None]
    return max(round(float(np.median(diameters)), 4), 1e-4) if diameters else None


def answers(entry: PhotographEntry, trace: Trace) -> tuple[dict[int, bool], frozenset[int]]:
    """
    Return which strand is above at crossings: index -> whether the first is; and the indices of answers.

    An answer belongs to the nearest crossing; of several answers to one crossing, the last counts.
    """
    above = {k: crossing.first_above for k, crossing in enumerate(trace.crossings)
             if crossing.first_above is not None}
    answered = set()
    places = np.array([crossing.pixel for crossing in trace.crossings]).reshape(-1, 2)
    for answer in entry.crossings:
        distances = np.linalg.norm(places - answer.pixel, axis=1)
        if len(distances) and distances.min() <= ANSWER_REACH * trace.width:
            nearest = int(distances.argmin())
            above[nearest] = answer.first_above
            answered.add(nearest)
    return above, frozenset(answered)


def numbers(array: Floats, digits: int = 2) -> list[Any]:
    """Return an array as lists, rounded; what is not a number becomes None."""
    rounded = np.round(np.asarray(array, float), digits)
    values: Any = rounded.astype(object)
    values[~np.isfinite(rounded)] = None
    plain: list[Any] = values.tolist()
    return plain
