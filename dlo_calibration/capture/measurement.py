# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measurement: the scale, the line of the DLO, and its axis in metres, as measured in a photograph."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Callable, Hashable, Mapping, Sequence, TypeVar, Union

import numpy as np

from dlo_calibration.capture.document import (
    BoardScale,
    Document,
    HangingScale,
    PhotographEntry,
    PointsScale,
)
from dlo_calibration.capture.hanging import COUNT, hanging_dlo, HangingDlo, straight_down
from dlo_calibration.capture.project import Project
from dlo_calibration.errors import DEFECT, InputError
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.vision.axis import Axis, axis_of, measured_diameter
from dlo_calibration.vision.board import find_board
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.middle_line import along_line, arc_lengths
from dlo_calibration.vision.photograph import Photograph
from dlo_calibration.vision.pose import scale_from_length, scale_from_points
from dlo_calibration.vision.scale import grid, Scale
from dlo_calibration.vision.tracer import Trace, Tracer

ANSWER_REACH = 3.0  # widths of the DLO between a crossing and the pixel of the answer that belongs to it
LATTICE = 25, 19  # columns and rows of pixels whose places on the table are sent to the page
TRACERS = 3  # in memory, each with its prepared photograph

Value = TypeVar('Value')


@dataclass(frozen=True, eq=False)
class Measurement:
    """
    The measurement of a photograph.

    :param problem: why the photograph cannot be read; likewise `scale_problem` and `trace_problem`.
    :param marks: (k, 2) pixels of the points of its own scale; empty: it has another one's scale, or none.
    :param above: index of a crossing -> whether its first strand is above, as answered or else suggested.
    :param answered: indices of the crossings with an answer.
    :param diameter: of the DLO, measured in this photograph [m]; `thickness`: the one used for all [m].
    :param axis: of the DLO, if it lies on the table; `axis_problem`: why it has none.
    :param count: number of points of the chain.
    :param hanging: the DLO, if it hangs between clamps.
    """

    entry: PhotographEntry
    size: tuple[int, int] = (0, 0)
    problem: str | None = None
    scale: Scale | None = None
    scale_problem: str | None = None
    marks: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    trace: Trace | None = None
    trace_problem: str | None = None
    above: Mapping[int, bool] = field(default_factory=dict)
    answered: frozenset[int] = frozenset()
    diameter: float | None = None
    thickness: float | None = None
    axis: Axis | None = None
    axis_problem: str | None = None
    count: int = 21
    hanging: HangingDlo | None = None

    @property
    def trial_scale(self) -> Scale | None:
        """The scale in the frame of the photograph's trial."""
        return self.scale if self.hanging is None else self.hanging.scale

    @cached_property
    def chain(self) -> Chain | None:
        """The chain of evenly spaced points; None without a scale or a line."""
        return None if self.axis is None else self.axis.chain(np.linspace(0.0, 1.0, self.count))

    @cached_property
    def plain(self) -> dict[str, Any]:
        """The measurement as plain values, for the page."""
        return {'width': self.size[0], 'height': self.size[1], 'problem': self.problem,
                'scale': self._plain_scale(), 'scale_problem': self.scale_problem,
                'trace': self._plain_trace(), 'trace_problem': self.trace_problem}

    def _plain_scale(self) -> dict[str, Any] | None:
        if self.scale is None:
            return None
        return {'residual': self.scale.residual, 'residuals': numbers(self.scale.residuals, 6),
                'warnings': list(self.scale.warnings),
                'grid': [{'pixels': numbers(line, 1), 'label': label}
                         for label, line in grid(self.scale)],
                'pixels': numbers(self.marks),
                'lattice': _lattice(self.scale)}

    def _plain_trace(self) -> dict[str, Any] | None:
        trace, axis = self.trace, self.axis
        if trace is None:
            return None
        crossings = [{'pixel': numbers(np.array(crossing.pixel)), 'first_above': self.above.get(k),
                      'answered': k in self.answered, 'suggested': crossing.first_above}
                     for k, crossing in enumerate(trace.crossings)]
        chain = None
        if self.hanging is not None:
            chain = numbers(self.hanging.scale.to_pixels(self.hanging.chain.points[1:-1]))
        elif axis is not None:
            along = arc_lengths(trace.pixels)
            places = np.interp(np.linspace(0.0, axis.length, self.count), axis.along, along)
            chain = numbers(along_line(trace.pixels, along, places))
        return {'pixels': numbers(trace.pixels), 'sure': trace.sure.tolist(), 'width': trace.width,
                'crossings': crossings, 'length': self._length,
                'diameter': self.diameter, 'chain': chain}

    @property
    def _length(self) -> float | None:
        if self.hanging is not None:
            return float(arc_lengths(self.hanging.chain.points[1:-1])[-1])
        return None if self.axis is None else self.axis.length


def _lattice(scale: Scale) -> dict[str, Any]:
    """Return columns and rows of pixels, and the places on the table of the crossings in each row [m]."""
    width, height = scale.size
    columns, rows = np.linspace(0, width - 1, LATTICE[0]), np.linspace(0, height - 1, LATTICE[1])
    table = scale.points(np.stack(np.meshgrid(columns, rows), axis=-1))[:, :2].reshape(*LATTICE[::-1], 2)
    shown = ~np.isnan(table).any(axis=(1, 2))  # rows below the horizon
    return {'columns': numbers(columns, 2), 'rows': numbers(rows[shown], 2),
            'table': numbers(table[shown], 6)}


class Measurer:
    """
    Measures the photographs of a project; unchanged parts are cached, so that a click costs one trace.

    It belongs to one thread.  `tracer` returns the tracer of a photograph, given by its id.
    """

    def __init__(self, project: Project) -> None:
        self._project = project
        self._document = project.document  # the one that is being measured
        self.tracer = lru_cache(TRACERS)(lambda photograph: Tracer(project.photograph(photograph).pixels))
        self._cache: dict[tuple[str, str], tuple[Hashable, Any]] = {}  # step, photograph -> key, value

    def measure(self, document: Document) -> dict[str, Measurement]:
        """Return the measurement of each photograph of a document, by its id."""
        self._document = document
        self._cache = {key: value for key, value in self._cache.items() if key[1] in document.by_id}
        measured = {entry.id: self._measured(entry) for entry in document.photographs}
        sides = {side for trial in document.trials for side in (trial.start_side, trial.goal_side)}
        diameter = document.dlo.diameter or _median_diameter(
            [measurement for name, measurement in measured.items() if name not in sides])
        return {name: self._with_axis(measurement, diameter) for name, measurement in measured.items()}

    def _attempt(self, step: str, photograph: str, key: Hashable,
                 make: Callable[[], Value]) -> Union[Value, InputError]:
        """Return the value of `make` or its error; it is called only if the key changed."""
        cached = self._cache.get((step, photograph))
        if cached is not None and cached[0] == key:
            return cached[1]  # type: ignore[no-any-return]
        value: Union[Value, InputError]
        try:
            value = make()
        except InputError as error:
            value = error
        except Exception as error:  # a defect of this package must not cost the other photographs
            value = InputError(f'{step} of the photograph', repr(error), 'a result', DEFECT)
        self._cache[step, photograph] = key, value
        return value

    def _measured(self, entry: PhotographEntry) -> Measurement:
        """Return the measurement of a photograph, without the axis."""
        size = self._attempt('size', entry.id, (), lambda: self._project.photograph(entry.id).size)
        if isinstance(size, InputError):
            return Measurement(entry, problem=str(size))
        measurement = Measurement(entry, size, count=self._document.dlo.points)
        if isinstance(entry.scale, HangingScale):
            return self._hanging(measurement, entry.scale)
        owner = self._document.scale_of(entry)
        marked = self._scale(owner, entry, size)
        if isinstance(marked, InputError):
            measurement = replace(measurement, scale_problem=str(marked))
        elif marked is not None:
            scale, marks = marked
            measurement = replace(measurement, scale=scale, marks=marks if owner is entry else marks[:0])
        if len(entry.clicks) < 2:
            return measurement
        trace = self._attempt('trace', entry.id, entry.clicks,
                              lambda: self.tracer(entry.id).trace(np.array(entry.clicks)))
        if isinstance(trace, InputError):
            return replace(measurement, trace_problem=str(trace))
        above, answered = answers(entry, trace)
        diameter = None
        if measurement.scale is not None:
            diameter = self._attempt('diameter', entry.id, (trace, measurement.scale), partial(
                measured_diameter, trace, measurement.scale))
        return replace(measurement, trace=trace, above=above, answered=answered,
                       diameter=None if isinstance(diameter, InputError) else diameter)

    def _hanging(self, measurement: Measurement, given: HangingScale) -> Measurement:
        """Return the measurement of a photograph of a DLO that hangs; its line gives the scale."""
        entry = measurement.entry
        if len(entry.clicks) < 2:
            return measurement
        trace = self._attempt('trace', entry.id, (entry.clicks, given.kind), lambda: (
            self.tracer(entry.id).trace(np.array(entry.clicks), clamped=True)))
        if isinstance(trace, InputError):
            return replace(measurement, trace_problem=str(trace))
        measurement = replace(measurement, trace=trace)
        if given.length is None and given.gap is None:
            return measurement
        lens = self._project.lens
        measured = self._attempt('scale', entry.id, (trace, given, lens), partial(
            self._hung, trace, given, lens, self._project.photograph(entry.id)))
        if isinstance(measured, InputError):
            return replace(measurement, scale_problem=str(measured))
        scale, diameter, hanging = measured
        return replace(measurement, scale=scale, diameter=diameter, hanging=hanging)

    def _hung(self, trace: Trace, given: HangingScale, lens: Lens | None, photograph: Photograph
              ) -> tuple[Scale, float, HangingDlo]:
        """Return the scale of a DLO that hangs, its diameter [m], and the DLO."""
        line = trace.pixels[[0, -1]] if given.length is None else trace.pixels
        scale = scale_from_length(line, given.length or given.gap or 0.0, photograph.size, lens,
                                  photograph.focal_length)
        clamps = np.array(given.clamps) if len(given.clamps) == 2 else None
        hanging = hanging_dlo(trace, scale, straight_down(scale, trace.pixels), COUNT, clamps=clamps)
        return scale, measured_diameter(trace, scale), hanging

    def _scale(self, owner: PhotographEntry, entry: PhotographEntry,
               size: tuple[int, int]) -> Union[tuple[Scale, Floats], InputError, None]:
        """Return the scale of a photograph, its own or that of its `owner`, and the owner's marks (k, 2)."""
        if owner.scale is None:
            return None
        lens = self._project.lens
        marked = self._attempt('scale', owner.id, (owner.scale, lens), lambda: self._marked(owner, lens))
        if isinstance(marked, tuple) and marked[0].size != size:
            return InputError(f'scale of {entry.name}', f'that of {owner.name}, which has another size',
                              'one of the same camera', 'give this photograph a scale of its own')
        return marked

    def _marked(self, owner: PhotographEntry, lens: Lens | None) -> tuple[Scale, Floats]:
        photograph = self._project.photograph(owner.id)
        if isinstance(owner.scale, BoardScale):
            pixels, table = find_board(photograph.pixels, printed=owner.scale.ruler)
        else:
            assert isinstance(owner.scale, PointsScale)
            pixels, table = (np.array([getattr(point, name) for point in owner.scale.points]).reshape(-1, 2)
                             for name in ('pixel', 'table'))
        return scale_from_points(pixels, table, photograph.size, lens, photograph.focal_length), pixels

    def _with_axis(self, measurement: Measurement, diameter: float | None) -> Measurement:
        """Return a measurement with the axis; the same object until something changes."""
        trace, scale, photograph = measurement.trace, measurement.scale, measurement.entry.id
        axis: Union[Axis, InputError, None] = None
        lies = measurement.hanging is None
        if lies and trace is not None and scale is not None and diameter is not None:
            key = trace, scale, diameter, measurement.count, tuple(sorted(measurement.above.items()))
            axis = self._attempt('axis', photograph, key, lambda: axis_of(
                trace, scale, diameter, measurement.count, measurement.above))
        problem, axis = (str(axis), None) if isinstance(axis, InputError) else (None, axis)
        completed = replace(measurement, thickness=diameter, axis=axis, axis_problem=problem)
        inputs = measurement.entry, scale, trace, axis, measurement.scale_problem, measurement.count, diameter
        return self._attempt('result', photograph, inputs, lambda: completed)  # type: ignore[return-value]


def _median_diameter(measurements: Sequence[Measurement]) -> float | None:
    """Return the median of the measured diameters, to a tenth of a millimetre [m]."""
    diameters = [measurement.diameter for measurement in measurements if measurement.diameter is not None]
    return max(round(float(np.median(diameters)), 4), 1e-4) if diameters else None


def answers(entry: PhotographEntry, trace: Trace) -> tuple[dict[int, bool], frozenset[int]]:
    """
    Return index of a crossing -> whether its first strand is above, and the indices with an answer.

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
    """Return an array as lists, rounded; nan and infinity become None."""
    rounded = np.round(np.asarray(array, float), digits)
    values: Any = rounded.astype(object)
    values[~np.isfinite(rounded)] = None
    return list(values.tolist())
