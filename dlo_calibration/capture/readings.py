# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Readings: what was read out of each photograph: its scale, the DLO's line, and the axis in metres."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
import time
from typing import Any, Callable, Hashable, Mapping, Sequence, TypeVar, Union

import numpy as np

from dlo_calibration.capture.board import find_board
from dlo_calibration.capture.camera import Lens
from dlo_calibration.capture.chains import along_line, arc_lengths, Axis, axis_of, measured_diameter
from dlo_calibration.capture.document import BoardScale, Document, PhotographEntry, PointsScale
from dlo_calibration.capture.grid import grid
from dlo_calibration.capture.pose import scale_from_points
from dlo_calibration.capture.project import Project
from dlo_calibration.capture.scale import Scale
from dlo_calibration.capture.trace import Trace, Tracer
from dlo_calibration.errors import DEFECT, InputError
from dlo_calibration.model.chain import Chain, Floats

ANSWER_REACH = 3.0  # widths of the DLO between a crossing and the pixel of the answer that belongs to it
GRID_POINTS = 25  # of a line of the grid that is drawn
LATTICE = 25, 19  # columns and rows of pixels whose places on the table the page is told
TRACERS = 3  # kept in memory, each with what it prepared of its photograph

Value = TypeVar('Value')
Numbers = list[Any]


@dataclass(frozen=True, eq=False)
class Marked:
    """
    The points that a scale was made of.

    :param pixels: (k, 2) [px].
    :param table: (k, 2) [m].
    """

    scale: Scale
    pixels: Floats
    table: Floats


@dataclass(frozen=True, eq=False)
class Reading:
    """
    What was read out of a photograph.

    :param problem: why the photograph cannot be read; likewise `scale_problem` and `trace_problem`.
    :param marked: the points of its own scale; None where it has another's.
    :param seconds: that tracing took.
    :param above: index of a crossing -> whether its first strand is above, as answered or else suggested.
    :param answered: indices of the crossings with an answer.
    :param diameter: of the DLO, as measured in this photograph [m]; `thickness`: as it is used for all.
    :param axis: of the DLO, if it lies on the table; `axis_problem`: why it cannot.
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
                'grid': [{'pixels': numbers(thinned(line.pixels), 1), 'label': line.label}
                         for line in grid(self.scale)],
                'pixels': [] if own is None else numbers(own.pixels),
                'table': [] if own is None else numbers(own.table, 6),
                'lattice': _lattice(self.scale)}

    def _plain_trace(self) -> dict[str, Any] | None:
        trace = self.trace
        if trace is None:
            return None
        crossings = [{'pixel': numbers(np.array(one.pixel)), 'first_above': self.above.get(k),
                      'answered': k in self.answered, 'suggested': one.first_above}
                     for k, one in enumerate(trace.crossings)]
        along = arc_lengths(trace.pixels)
        return {'pixels': numbers(trace.pixels), 'sure': trace.sure.tolist(), 'width': trace.width,
                'crossings': crossings, 'length': None if self.axis is None else self.axis.length,
                'diameter': self.diameter, 'seconds': self.seconds,
                'chain': None if self.axis is None else numbers(along_line(
                    trace.pixels, along, self._pixel_lengths(along)))}

    def _pixel_lengths(self, along: Floats) -> Floats:
        """Return the arc lengths in the photograph (n,) [px] of the chain's points."""
        assert self.axis is not None
        places = np.linspace(0.0, self.axis.length, self.count)
        return np.asarray(np.interp(places, self.axis.along, along))


def _lattice(scale: Scale) -> dict[str, Any]:
    """Return columns and rows of pixels, and where on the table each row of their crossings is [m]."""
    width, height = scale.size
    columns, rows = np.linspace(0, width - 1, LATTICE[0]), np.linspace(0, height - 1, LATTICE[1])
    table = scale.points(np.stack(np.meshgrid(columns, rows), axis=-1))[:, :2].reshape(*LATTICE[::-1], 2)
    shown = ~np.isnan(table).any(axis=(1, 2))  # rows below the horizon
    return {'columns': numbers(columns, 2), 'rows': numbers(rows[shown], 2),
            'table': numbers(table[shown], 6)}


class Reader:
    """
    Reads photographs of a project, and remembers what it read, so that a click costs one trace.

    It belongs to one thread.
    """

    def __init__(self, project: Project) -> None:
        self._project = project
        self._document = project.document  # as it is while it is read
        self._tracers: OrderedDict[str, Tracer] = OrderedDict()
        self._known: dict[tuple[str, str], tuple[Hashable, Any]] = {}

    def readings(self, document: Document) -> dict[str, Reading]:
        """Return what is read out of each photograph of a document, by its id."""
        self._document = document
        ids = {entry.id for entry in document.photographs}
        self._known = {key: value for key, value in self._known.items() if key[1] in ids}
        found = {}
        for entry in document.photographs:
            size = self._attempt('size', entry.id, (), partial(self._size, entry.id))
            if isinstance(size, InputError):
                found[entry.id] = Reading(entry, problem=str(size))
                continue
            marked = self._scale(entry)
            traced = self._trace(entry)
            found[entry.id] = self._reading(entry, size, marked, traced)
        sides = {one for trial in document.trials for one in (trial.start_side, trial.goal_side)}
        diameter = document.dlo.diameter or _median_diameter(
            [reading for one, reading in found.items() if one not in sides])
        return {one: self._with_axis(reading, diameter) for one, reading in found.items()}

    def prepare(self, one: str) -> None:
        """
        Prepare what the traces of a photograph, given by its id, need, so that the first click is not slower.

        :raises InputError: where it cannot be read.
        """
        self._tracer(one).prepare()

    def _attempt(self, what: str, one: str, key: Hashable,
                 make: Callable[[], Value]) -> Union[Value, InputError]:
        """Return what `make` returns or refuses, made anew only where the key changed."""
        known = self._known.get((what, one))
        if known is not None and known[0] == key:
            return known[1]  # type: ignore[no-any-return]
        value: Union[Value, InputError]
        try:
            value = make()
        except InputError as error:
            value = error
        except Exception as error:  # a defect of this package must not cost the other photographs
            value = InputError(f'{what} of the photograph', repr(error), 'something that can be used', DEFECT)
        self._known[what, one] = key, value
        return value

    def _size(self, one: str) -> tuple[int, int]:
        return self._project.photograph(one).size

    def _scale(self, entry: PhotographEntry) -> Union[Marked, InputError, None]:
        owner = self._document.scale_of(entry)
        if owner.scale is None:
            return None
        lens = self._project.lens
        made = self._attempt('scale', owner.id, (owner.scale, lens), lambda: self._marked(owner, lens))
        if owner.id != entry.id and not isinstance(made, InputError):
            size = self._attempt('size', entry.id, (), lambda: self._size(entry.id))
            if size != made.scale.size:
                return InputError(f'scale of {entry.name}', f'that of {owner.name}, which has another size',
                                  'one of the same camera', 'give this photograph a scale of its own')
        return made

    def _marked(self, owner: PhotographEntry, lens: Lens | None) -> Marked:
        photograph = self._project.photograph(owner.id)
        if isinstance(owner.scale, BoardScale):
            pixels, table = find_board(photograph.pixels, printed=owner.scale.ruler)
        else:
            assert isinstance(owner.scale, PointsScale)
            pixels = np.array([pixel for pixel, _ in owner.scale.points]).reshape(-1, 2)
            table = np.array([place for _, place in owner.scale.points]).reshape(-1, 2)
        scale = scale_from_points(pixels, table, photograph.size, lens, photograph.focal_length)
        return Marked(scale, pixels, table)

    def _trace(self, entry: PhotographEntry) -> Union[tuple[Trace, float], InputError, None]:
        if len(entry.clicks) < 2:
            return None
        return self._attempt('trace', entry.id, entry.clicks, lambda: self._traced(entry))

    def _traced(self, entry: PhotographEntry) -> tuple[Trace, float]:
        begin = time.perf_counter()
        trace = self._tracer(entry.id).trace(np.array(entry.clicks))
        return trace, time.perf_counter() - begin

    def _tracer(self, one: str) -> Tracer:
        if one not in self._tracers:
            self._tracers[one] = Tracer(self._project.photograph(one).pixels)
            while len(self._tracers) > TRACERS:
                self._tracers.popitem(last=False)
        self._tracers.move_to_end(one)
        return self._tracers[one]

    def _reading(self, entry: PhotographEntry, size: tuple[int, int], marked: Union[Marked, InputError, None],
                 traced: Union[tuple[Trace, float], InputError, None]) -> Reading:
        scale_problem = str(marked) if isinstance(marked, InputError) else None
        scale = marked.scale if isinstance(marked, Marked) else None
        mine = self._document.scale_of(entry) is entry
        own = marked if isinstance(marked, Marked) and mine else None
        count = self._document.dlo.points
        if traced is None or isinstance(traced, InputError):
            return Reading(entry, size, None, scale, scale_problem, own,
                           trace_problem=None if traced is None else str(traced), count=count)
        trace, seconds = traced
        above, answered = answers(entry, trace)
        width = None if scale is None else self._attempt(
            'diameter', entry.id, (trace, scale), lambda: measured_diameter(trace, scale))
        return Reading(entry, size, None, scale, scale_problem, own, trace, None, seconds, above, answered,
                       None if isinstance(width, InputError) else width, count=count)

    def _with_axis(self, reading: Reading, diameter: float | None) -> Reading:
        trace, scale = reading.trace, reading.scale
        axis: Union[Axis, InputError, None] = None
        if trace is not None and scale is not None and diameter is not None:
            key = trace, scale, diameter, reading.count, tuple(sorted(reading.above.items()))
            axis = self._attempt('axis', reading.entry.id, key, lambda: axis_of(
                trace, scale, diameter, reading.count, reading.above))
        # The same object, with what the page draws of it, as long as nothing changed.
        whole = reading.entry, reading.scale, trace, axis, reading.scale_problem, reading.count, diameter
        return self._attempt('reading', reading.entry.id, whole, lambda: _completed(  # type: ignore[return-value]
            reading, axis, diameter))


def _completed(reading: Reading, axis: Union[Axis, InputError, None], diameter: float | None) -> Reading:
    if isinstance(axis, InputError):
        return replace(reading, thickness=diameter, axis_problem=str(axis))
    return replace(reading, thickness=diameter, axis=axis)


def _median_diameter(readings: Sequence[Reading]) -> float | None:
    """Return the diameter as measured in most photographs, to a tenth of a millimetre [m]."""
    measured = [one.diameter for one in readings if one.diameter is not None]
    return max(round(float(np.median(measured)), 4), 1e-4) if measured else None


def answers(entry: PhotographEntry, trace: Trace) -> tuple[dict[int, bool], frozenset[int]]:
    """
    Return which strand is above at crossings: index -> whether the first is; and the indices of answers.

    An answer belongs to the nearest crossing; of several answers to one crossing, the last counts.
    """
    above = {k: one.first_above for k, one in enumerate(trace.crossings) if one.first_above is not None}
    answered = set()
    places = np.array([one.pixel for one in trace.crossings]).reshape(-1, 2)
    for answer in entry.crossings:
        distances = np.linalg.norm(places - answer.pixel, axis=1)
        if len(distances) and distances.min() <= ANSWER_REACH * trace.width:
            nearest = int(distances.argmin())
            above[nearest] = answer.first_above
            answered.add(nearest)
    return above, frozenset(answered)


def thinned(line: Floats) -> Floats:
    """Return at most some points (m, 2) of a line (n, 2), with both ends."""
    chosen = np.linspace(0, len(line) - 1, min(len(line), GRID_POINTS)).round().astype(int)
    return np.asarray(line[chosen])


def numbers(array: Floats, digits: int = 2) -> Numbers:
    """Return an array as lists, rounded; what is not a number becomes None."""
    rounded = np.round(np.asarray(array, float), digits)
    values: Any = rounded.astype(object)
    values[~np.isfinite(rounded)] = None
    plain: Numbers = values.tolist()
    return plain
