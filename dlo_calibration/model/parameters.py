# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameters: their values on the paper's scale from 0 to 100, and their physical quantities.

The package computes in SI units; the scale from 0 to 100 exists here and at the
edges (messages, files, tables).  A search has units of its own, see `Parameter.stride`.
A new parameter is one more entry of PARAMETERS; an engine reads its physical value by
name.  The formulas at the end define the parameters of bending for a piece of DLO: the
rest shape, and the moment that bends it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math
import re
from typing import Any, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError, suggestion
from dlo_calibration.model.chain import Floats


def exact(value: Any) -> str:
    """Return a value as text from which a program reads it back exactly."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, (tuple, list)):
        return ' '.join(map(exact, value))
    return str(value) if isinstance(value, (int, str)) else repr(float(value))


def number(value: float | None, beside: float | None = None) -> str:
    """
    Return a number with three significant digits, for people; a dash where it is unknown.

    Only a very large or very small number has a power of ten.

    :param beside: a number next to it in a text: both have the power of ten of the larger one.
    """
    if value is None or not math.isfinite(value):
        return '-'
    if value == 0:
        return '0'  # -0.0, too
    largest = max(abs(value), abs(beside) if beside is not None and math.isfinite(beside) else 0.0)
    exponent = 0 if 1e-3 <= largest < 1e6 else int(f'{largest:.2e}'.partition('e')[2])
    digits = np.format_float_positional(
        value / 10.0**exponent, precision=3, unique=False, fractional=False, trim='-')
    return f'{digits}e{exponent}' if exponent else digits


def measured(value: float | None, unit: str, beside: float | None = None) -> str:
    """
    Return a physical value (SI) with its unit, for people: lengths in mm, coefficients without unit.

    :param beside: see `number`: for a value next to its interval, the end that is further from 0.
    """
    return _with_unit([value], unit, beside)


def interval(lower: float | None, upper: float | None, unit: str) -> str:
    """Return both ends of an interval (SI) with their unit, as `measured` writes one value."""
    return _with_unit([lower, upper], unit, max(lower or 0.0, upper or 0.0, key=abs))


def _with_unit(values: Sequence[float | None], unit: str, beside: float | None) -> str:
    factor, name = (1e3, 'mm') if unit == 'm' else (1.0, unit)
    text = ' to '.join(number(value and factor * value, beside and factor * beside) for value in values)
    return text if unit == '1' else f'{text} {name}'


SCALE = 100.0  # the upper end of the paper's scale
GRAVITY = 9.81  # m/s^2
ASSUMED_DENSITY = 0.05  # kg/m, of a DLO of unknown mass, about that of a polyester rope of 8 mm
PER_WEIGHT = 'per N/m'  # ends the unit of a stiffness that is divided by the weight per length


@dataclass(frozen=True)
class Parameter:
    """
    One parameter of a DLO, on a scale from 0 to 100.

    :param at_zero: physical value at 0.
    :param at_hundred: physical value at 100.
    :param default: value on the 0..100 scale of a parameter that is neither calibrated nor fixed.
    :param linear: True for a linear scale, False for a logarithmic one.
    :param neutral: exact physical value at the default, where the parameter has no effect
        there: 1 for a ratio, or 0, which a logarithmic scale does not contain.
    :param per_weight: True if motion under gravity depends only on the ratio of this
        parameter to the DLO's weight; this ratio is reported where the mass is unknown.
    :param stride: ratio of two physical values (their difference on a linear scale) that are one unit of a
        search apart; None: that of both ends of the scale. Steps and tolerances of a search, and what counts
        as known, are shares of this unit, so that they stay the same where a scale becomes wider.
    """

    name: str
    quantity: str
    unit: str
    at_zero: float
    at_hundred: float
    default: float
    description: str
    per_weight: bool = False
    linear: bool = False
    neutral: float | None = None
    stride: float | None = None

    @property
    def extent(self) -> float:
        """The length of the scale in units of a search."""
        if self.stride is None:
            return 1.0
        return (self.at_hundred - self.at_zero) / self.stride if self.linear else \
            abs(math.log(self.at_hundred / self.at_zero)) / math.log(self.stride)

    def coordinate(self, physical: float) -> float:
        """Return the coordinate of a physical value in the box of a search, or beyond it."""
        return self.value(physical) / SCALE * self.extent

    def physical(self, value: float) -> float:
        """Return the physical value, in `unit`, of `value` on the 0..100 scale."""
        if self.neutral is not None and value == self.default:
            return self.neutral
        if self.linear:
            return self.at_zero + (self.at_hundred - self.at_zero) * value / SCALE
        return self.at_zero * math.pow(self.at_hundred / self.at_zero, value / SCALE)

    def value(self, physical: float) -> float:
        """Return the value on the 0..100 scale, or beyond it, of a physical one (> 0 if logarithmic)."""
        if physical == self.neutral:
            return self.default
        if self.linear:
            return SCALE * (physical - self.at_zero) / (self.at_hundred - self.at_zero)
        return SCALE * math.log(physical / self.at_zero) / math.log(self.at_hundred / self.at_zero)

    def interval(self, lower: float, upper: float, physical: tuple[float, float], unit: str) -> str:
        """
        Return an interval for people; one that reaches one end of the scale is a bound: at least, or at most.

        :param lower: its lower end on the 0..100 scale; `upper` its upper end.
        :param physical: the lower and the upper physical value in it, in `unit`.
        """
        if (lower <= 0) == (upper >= SCALE):
            return interval(physical[0], physical[1], unit)
        grows = self.at_hundred > self.at_zero
        return f'at most {measured(physical[1], unit)}' if (lower <= 0) == grows else \
            f'at least {measured(physical[0], unit, physical[1])}'


MOST_PARTS = 8  # with bending stiffnesses of their own: the DLO can be halved three times
LOCKING = 'locking'  # name of the parameter of cables that become stiffer as they bend
MOST_LOCKED = 30.0  # largest stiffening by locking, as in the core
KNOTS = (3, 5, 9)  # of a rest shape that varies: each number keeps the places of the previous one


def part_name(part: int) -> str:
    """Return the name of the stiffness of a part of the DLO, counted from 1; part 1 has `flexibility`."""
    return 'flexibility' if part == 1 else f'stiffness_{part}'


def knot_names(knots: int) -> tuple[str, ...]:
    """Return the names of both components of the natural curvature at knots 1 to `knots`."""
    return tuple(f'rest_curvature_{axis}{knot}' for knot in range(1, knots + 1) for axis in 'xy')


#: Names of the stiffnesses, relative to that at the first knot, of a DLO whose stiffness varies smoothly.
STIFFNESS_KNOTS = tuple(f'stiffness_knot_{knot}' for knot in range(2, 6))
PIECES = 64  # into which such a DLO is divided, as in the core
#: Names of both components of the bend where the DLO leaves its clamps.
CLAMP_BENDS = tuple(f'clamp_bend_{axis}{clamp}' for clamp in (1, 2) for axis in 'xy')


#: The paper's four, then those that are fixed by default.
PARAMETERS: tuple[Parameter, ...] = (
    Parameter('flexibility', 'bending stiffness EI', 'N m^2', 10**1.0, 10**-5.5, 65.4,
              'how easily the DLO bends', per_weight=True, stride=10**4.5),
    Parameter('elasticity', 'stretching stiffness EA', 'N', 1e4, 1e0, 25.0,
              'how easily the DLO stretches', per_weight=True),
    Parameter('friction', 'Coulomb friction coefficient', '1', 10**-2.0, 10**0.3, 70.0,
              'friction of the DLO with the table and with itself'),
    Parameter('self_collision', 'self-collision radius', 'm', 2e-3, 3e-2, 25.0,
              'radius of the DLO where it touches itself'),
    Parameter('damping', 'drag per mass', '1/s', 1e-2, 1e2, 50.0,
              'how fast drag in the air slows the DLO'),
    Parameter('internal_damping', 'stiffness-proportional damping', 's', 1e-3, 1e-1, 12.8,
              'how fast bending and stretching vibrations fade'),
    Parameter('mass', 'mass of the whole DLO', 'kg', 1e-3, 1e1, 42.0, 'mass of the whole DLO'),
    Parameter('length_scale', 'rest length relative to the observed length', '1', 0.9, 1 / 0.9, 50.0,
              'correction of the observed length', neutral=1.0),
    Parameter('natural_curvature', 'curvature of the rest shape', '1/m', 0.0, 10.0, 0.0,
              'how curved the DLO is when nothing bends it', linear=True, neutral=0.0),
    Parameter('marker_mass', 'mass at each point annotated as a feature', 'kg', 1e-6, 1e-1, 0.0,
              'how heavy each marker or plug on the DLO is (0: no mass)', per_weight=True,
              neutral=0.0),
    Parameter('torsion', 'ratio of twisting stiffness GJ to bending stiffness EI', '1', 1e-2, 1e1, 0.0,
              'how much the DLO resists twist between two clamps (0: not at all)', neutral=0.0),
    Parameter('bending_friction', 'largest moment of friction inside the DLO, relative to EI', '1/m', 1e-2,
              1e2, 0.0, 'how much of a bend the DLO keeps, by friction between its strands', neutral=0.0),
    Parameter('bending_slip', 'change of curvature at which the strands slip', '1/m', 1e-3, 1e1, 50.0,
              'how far the DLO bends before its strands slip (no effect without bending_friction)'),
    Parameter(LOCKING, 'bend radius at which the bending stiffness has doubled', 'm', 3e-3, 1e0, 0.0,
              'how soon a DLO of strands becomes stiffer as it bends (0: never)', neutral=0.0),
    *(Parameter(part_name(part), f'bending stiffness of part {part} relative to part 1', '1', 0.02, 50.0,
                50.0, f'how stiff part {part} of the DLO is (see parts)', neutral=1.0)
      for part in range(2, MOST_PARTS + 1)),
    *(Parameter(name, f'bending stiffness at knot {name[-1]} relative to knot 1', '1', 0.02, 50.0, 50.0,
                f'how stiff the DLO is at knot {name[-1]} of {len(STIFFNESS_KNOTS) + 1} (see parts)',
                neutral=1.0) for name in STIFFNESS_KNOTS),
    Parameter('hand_delay', 'delay of the stamps of actions', 's', -0.4, 0.4, 50.0,
              'by how much the stamps of actions are late', linear=True, neutral=0.0),
    *(Parameter(f'hand_shift_{axis}', f'shift of the hands in {axis}', 'm', -0.05, 0.05, 50.0,
                f'by how much hands are off in {axis} of the frame of the chains', linear=True, neutral=0.0)
      for axis in 'xyz'),
    Parameter('clamp_twist', 'angle between rest shape and second clamp', 'rad', -2 * math.pi, 2 * math.pi,
              50.0, 'how the DLO was turned about its axis when it was put into the second clamp (see parts)',
              linear=True, neutral=0.0),
    *(Parameter(name, f'component {name[-2]} of the curvature of the rest shape at knot {name[-1]}', '1/m',
                -25.0, 25.0, 50.0, 'how curved the DLO is there when nothing bends it (see parts)',
                linear=True, neutral=0.0) for name in knot_names(KNOTS[-1])),
    *(Parameter(name, f'component {name[-2]} of the bend at clamp {name[-1]}', 'rad', -0.5, 0.5, 50.0,
                'how bent the DLO is where it leaves this clamp, when nothing bends it (no effect without a '
                'rest shape)', linear=True, neutral=0.0) for name in CLAMP_BENDS),
)


def extents(names: Sequence[str]) -> Floats:
    """Return the (d,) lengths of the scales of parameters in units of a search."""
    return np.array([BY_NAME[name].extent for name in names])


def owner(name: str) -> tuple[str, int]:
    """Return the parameter of a name, and the number of the session whose own value it is; 0: of all."""
    match = _OWN.fullmatch(name)
    return (name, 0) if match is None else (match[1], int(match[2]))


def own_name(name: str, session: int) -> str:
    """Return the name of the value that a session, counted from 1, has for itself; the first has `name`."""
    return name if session == 1 else f'{name}_session_{session}'


class _Parameters(dict[str, Parameter]):
    """The parameters by name; those of sessions are made when they are asked for."""

    def __missing__(self, name: str) -> Parameter:
        base, session = owner(name)
        if not session or not super().__contains__(base):
            raise KeyError(name)
        return replace(self[base], name=name, quantity=f'{self[base].quantity} in session {session}')

    def __contains__(self, name: object) -> bool:
        return super().__contains__(owner(name)[0] if isinstance(name, str) else name)


MOST_SESSIONS = 20  # of one DLO
_OWN = re.compile(r'(\w+?)_session_([2-9]|1\d|20)')
BY_NAME: Mapping[str, Parameter] = _Parameters({parameter.name: parameter for parameter in PARAMETERS})
PART_NAMES = tuple(part_name(part) for part in range(2, MOST_PARTS + 1))
#: Of the hands, not of the DLO.
HANDS = ('hand_delay', 'hand_shift_x', 'hand_shift_y', 'hand_shift_z')
REST_SHAPE = ('clamp_twist', *knot_names(KNOTS[-1]))
#: How the DLO is when nothing bends it; only trials between two clamps show that.
REST_STATE = (*REST_SHAPE, *CLAMP_BENDS)
OWN_SHAPE = 'rest_shape'  # all of REST_SHAPE, where sessions have values of their own
PAPER_PARAMETERS = ('flexibility', 'elasticity', 'friction', 'self_collision')
SCALES = 2  # version of the scales in files; in the first, `flexibility` began at 0.1 N m^2
_FIRST_FLEXIBILITY = replace(BY_NAME['flexibility'], at_zero=0.1)


def from_first_scale(value: float) -> float:
    """Return a `flexibility` of version 1 of the scales on today's scale; both are 0 to 100."""
    return BY_NAME['flexibility'].value(_FIRST_FLEXIBILITY.physical(value))


def _absent_knots(knots: int) -> tuple[str, ...]:
    """Return the names of the rest shape's parameters that a DLO with this number of knots lacks."""
    return REST_SHAPE[1 + 2 * knots:] if knots else REST_STATE


@dataclass(frozen=True)
class ParameterSpace:
    """
    The parameters that a calibration finds, and the values of the others.

    The DLO has k parts of equal length if `stiffness_k` is the highest such name that is
    free or fixed; without any, it has one part. Likewise, its rest shape has the number
    of knots of `KNOTS` that the highest such name needs.

    A search moves in a box, from 0 to the extent of the scale of each free parameter.

    :param free: names of the parameters to find, in order.
    :param fixed: values of others on the 0..100 scale; the rest keep their defaults.
    :param mass: of the whole DLO [kg]; 0: unknown.
    """

    free: tuple[str, ...] = PAPER_PARAMETERS
    fixed: Mapping[str, float] = field(default_factory=dict)
    mass: float = 0.0

    def __post_init__(self) -> None:
        free = tuple(self.free)
        for name in (*free, *self.fixed):
            if name not in BY_NAME:
                raise InputError('parameter', repr(name), f'one of {", ".join(BY_NAME)}',
                                 suggestion(name, BY_NAME, 'correct the name'))
        if not free or len(set(free)) < len(free):
            raise InputError('calibrate', str(list(free)), 'one or more different names',
                             'name each parameter to find once')
        for name, value in self.fixed.items():
            if not 0 <= value <= SCALE:
                raise InputError(f'parameter {name}', f'{value:g}', 'a value from 0 to 100',
                                 'give it on the 0..100 scale')
        object.__setattr__(self, 'free', free)
        object.__setattr__(self, 'fixed', dict(self.fixed))

    @property
    def dimension(self) -> int:
        """Number of parameters to find."""
        return len(self.free)

    @property
    def upper(self) -> Floats:
        """The (d,) upper ends of the box of a search; the lower ones are 0."""
        return extents(self.free)

    @property
    def parts(self) -> int:
        """Number of parts of the DLO that have a bending stiffness of their own."""
        return max((part for part in range(1, MOST_PARTS + 1)
                    if part == 1 or part_name(part) in (*self.free, *self.fixed)))

    @property
    def knots(self) -> int:
        """Number of knots of the rest shape, of `KNOTS`; 0: its curvature is constant."""
        present = {*self.free, *self.fixed}
        if not present.intersection(REST_STATE):
            return 0
        return next(knots for knots in KNOTS if present.isdisjoint(REST_SHAPE[1 + 2 * knots:]))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The entries of PARAMETERS, without those of parts, knots and hands that are not in the space."""
        absent = {*PART_NAMES[self.parts - 1:], *_absent_knots(self.knots),
                  *{*HANDS, *CLAMP_BENDS, *STIFFNESS_KNOTS}.difference(self.free, self.fixed)}
        return tuple(parameter for parameter in PARAMETERS if parameter.name not in absent)

    def divided(self, parts: int) -> ParameterSpace:
        """
        Return the space of a DLO with `parts` parts of equal length.

        Where `flexibility` is free, the stiffnesses of all other parts are free too.
        """
        absent = PART_NAMES[parts - 1:]
        free = tuple(name for name in self.free if name not in absent)
        fixed = {name: value for name, value in self.fixed.items() if name not in absent}
        for name in PART_NAMES[:parts - 1]:
            if 'flexibility' in free and name not in free:
                free += (name,)
            elif name not in free:
                fixed.setdefault(name, BY_NAME[name].default)
        return ParameterSpace(free, fixed, self.mass)

    def halved(self, point: Sequence[float] | Floats) -> tuple[ParameterSpace, NDArray[np.float64]]:
        """Return the space with every part cut in two, and its point for the DLO at the (d,) `point`."""
        space = self.divided(2 * self.parts)
        values = {**self.fixed, **self.values(point)}
        for part in range(2, space.parts + 1):
            whole = part_name((part + 1) // 2)  # part 1 has no ratio: the others relate to it
            values[part_name(part)] = BY_NAME[part_name(part)].default if whole == 'flexibility' else \
                self.fixed.get(whole, self.values(point).get(whole, BY_NAME[whole].default))
        return space, space.point(values)

    def shaped(self, knots: int) -> ParameterSpace:
        """Return the space of a DLO whose rest shape has `knots` knots, all free; 0: none."""
        absent = _absent_knots(knots)
        free = tuple(name for name in self.free if name not in absent)
        fixed = {name: value for name, value in self.fixed.items() if name not in absent}
        if knots:
            free += tuple(name for name in REST_SHAPE[:1 + 2 * knots] if name not in (*free, *fixed))
        return ParameterSpace(free, fixed, self.mass)

    def with_knots(self, knots: int, point: Sequence[float] | Floats
                   ) -> tuple[ParameterSpace, NDArray[np.float64]]:
        """Return the space with other knots, all free, and its point for the DLO at the (d,) `point`."""
        values, now = {**self.fixed, **self.values(point)}, self.knots
        space = replace(self, fixed={name: value for name, value in self.fixed.items()
                                     if name not in REST_SHAPE}).shaped(knots)
        for axis in 'xy' if now else '':
            names = [f'rest_curvature_{axis}{knot}' for knot in range(1, max(knots, now) + 1)]
            components = [values.get(name, BY_NAME[name].default) for name in names[:now]]
            between = np.interp(np.linspace(0, 1, knots), np.linspace(0, 1, now), components)
            values.update(zip(names[:knots], between.tolist(), strict=True))
        return space, space.point({name: values.get(name, BY_NAME[name].default) for name in space.free})

    def freed(self, names: Sequence[str], point: Sequence[float] | Floats
              ) -> tuple[ParameterSpace, NDArray[np.float64]]:
        """Return the space in which these are free, too, and its point for the DLO at the (d,) `point`."""
        values = {**self.fixed, **self.values(point)}
        fixed = {name: value for name, value in self.fixed.items() if name not in names}
        space = replace(self, free=tuple(dict.fromkeys((*self.free, *names))), fixed=fixed)
        return space, space.point({name: values.get(name, BY_NAME[name].default) for name in space.free})

    @property
    def mass_known(self) -> bool:
        """Return whether physical values can be given in absolute units."""
        return self.mass > 0 or 'mass' in self.free or 'mass' in self.fixed

    def holds_in(self, name: str, session: int) -> bool:
        """Tell whether the value of this name holds in a session, counted from 1."""
        own = owner(name)[1]
        return own == session if own else own_name(name, session) not in self.free or session == 1

    def values(self, point: Sequence[float] | Floats) -> dict[str, float]:
        """Return the free parameters on the 0..100 scale at a (d,) point of the box."""
        return {name: float(u) / BY_NAME[name].extent * SCALE
                for name, u in zip(self.free, point, strict=True)}

    def point(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the (d,) point of the box at free parameters on the 0..100 scale."""
        return np.array([values[name] / SCALE * BY_NAME[name].extent for name in self.free])

    def default_point(self) -> NDArray[np.float64]:
        """Return the (d,) point of the box at the fixed values and, for the others, the defaults."""
        return self.point({name: self.fixed.get(name, BY_NAME[name].default) for name in self.free})

    def physical(self, values: Mapping[str, float], length: float) -> dict[str, float]:
        """
        Return the physical value of every parameter that the DLO has, by name.

        :param values: free parameters on the 0..100 scale.
        :param length: of the DLO [m], from which an unknown mass is assumed.
        """
        physical = {p.name: p.physical(values.get(p.name, self.fixed.get(p.name, p.default)))
                    for p in self.parameters}
        for name in filter(lambda name: owner(name)[1], (*values, *self.fixed)):
            physical[name] = BY_NAME[name].physical(values.get(name, self.fixed.get(name, 0.0)))
        if 'mass' not in values and 'mass' not in self.fixed:
            physical['mass'] = self.mass if self.mass > 0 else ASSUMED_DENSITY * length
        return physical

    def reported(self, name: str, value: float) -> tuple[float, str]:
        """
        Return the physical value to report for `value` on 0..100, and its unit.

        Where the mass is unknown, a stiffness is divided by the DLO's weight per
        length, as motion under gravity determines only this ratio.
        """
        parameter = BY_NAME[name]
        physical = parameter.physical(value)
        if parameter.per_weight and not self.mass_known:
            return physical / (ASSUMED_DENSITY * GRAVITY), f'{parameter.unit} {PER_WEIGHT}'
        return physical, parameter.unit


def of_session(physical: Mapping[str, float], session: int) -> dict[str, float]:
    """Return the physical values that hold in a session, counted from 1, by parameter name."""
    own = {owner(name)[0]: value for name, value in physical.items() if owner(name)[1] == session}
    return {**{name: value for name, value in physical.items() if not owner(name)[1]}, **own}


def stiffness_profile(physical: Mapping[str, float]) -> Floats:
    """
    Return the (m,) bending stiffnesses of pieces of equal length, relative to `flexibility`.

    :param physical: physical values by parameter name, in SI units.
    """
    parts = np.array([1.0, *(physical[name] for name in PART_NAMES if name in physical)])
    knots = [1.0, *(physical[name] for name in STIFFNESS_KNOTS if name in physical)]
    if len(knots) == 1:
        return parts
    middles = (np.arange(PIECES) + 0.5) / PIECES
    smooth = np.interp(middles, np.linspace(0, 1, len(knots)), knots)
    return np.asarray(parts[(middles * len(parts)).astype(int)] * smooth)


def natural_curvature(physical: Mapping[str, float], fractions: Floats) -> Floats:
    """
    Return the (m, 2) components [1/m] of the curvature of the rest shape, in the material frame.

    :param physical: physical values by parameter name, in SI units.
    :param fractions: (m,) of the length, 0 to 1.
    """
    curvature = np.zeros((len(fractions), 2))
    curvature[:, 0] = physical.get('natural_curvature', 0.0)
    components = [physical[name] for name in knot_names(KNOTS[-1]) if name in physical]
    for axis in range(2 if components else 0):
        values = components[axis::2]
        curvature[:, axis] += np.interp(fractions, np.linspace(0, 1, len(values)), values)
    return curvature


def rest_shape(curvatures: Floats, length: float) -> Floats:
    """
    Return the shapes (..., m + 2, 3) [m] that begin in the origin and lead along x.

    The material frame is not twisted, so that it turns about ``t x k`` from segment to segment (Bishop, There
    is more than one way to frame a curve, 1975).

    :param curvatures: (..., m, 2) [1/m] at the joints of m + 1 equal segments.
    :param length: [m].
    """
    step = length / (curvatures.shape[-2] + 1)
    frame = np.broadcast_to(np.eye(3), (*curvatures.shape[:-2], 3, 3))  # columns: tangent, two across it
    tangents = [frame[..., 0]]
    for k in range(curvatures.shape[-2]):
        first, second = curvatures[..., k, 0] * step, curvatures[..., k, 1] * step
        angle = np.hypot(first, second)
        along = np.stack([np.cos(angle), np.sinc(angle / np.pi) * first,
                          np.sinc(angle / np.pi) * second], axis=-1)
        # The smallest rotation from the x axis to `along`, of the frame's own axes.
        x, y, z = np.moveaxis(along, -1, 0)
        rest = 1 / np.maximum(1 + x, 1e-9)
        turn = np.stack([np.stack([x, -y, -z], axis=-1),
                         np.stack([y, 1 - y * y * rest, -y * z * rest], axis=-1),
                         np.stack([z, -y * z * rest, 1 - z * z * rest], axis=-1)], axis=-2)
        frame = frame @ turn
        tangents.append(frame[..., 0])
    steps = np.stack([np.zeros_like(tangents[0]), *tangents], axis=-2) * step
    return np.asarray(steps.cumsum(axis=-2))


def bending_moments(curvatures: Floats, stiffness: float, friction: float, slip: float, locking: float = 0.0
                    ) -> Floats:
    """
    Return the (m,) moments [N m] while a piece of DLO is bent in one plane.

    Strands that rub on each other are an elastic, perfectly plastic element beside the elastic bending (Iwan,
    A distributed-element model for hysteresis, 1966).  So each branch of a cycle is the first one, twice as
    large (Masing, 1926), and a cycle between -a and a takes the energy ``4 EI friction (a - slip)`` of each
    metre if a is larger than `slip`, and none if it is smaller.  Locking adds a part that takes no energy.

    :param curvatures: (m,) [1/m], from that of the rest shape; at the first, the strands are free of stress.
    :param stiffness: EI [N m^2].
    :param friction: largest moment of the friction between strands, relative to EI [1/m].
    :param slip: change of curvature at which they slip [1/m].
    :param locking: bend radius at which the elastic part has doubled [m]; 0: none.
    """
    stress = np.zeros(len(curvatures))
    for k, change in enumerate(np.diff(curvatures), start=1):
        stress[k] = np.clip(stress[k - 1] + friction / slip * change, -friction, friction)
    return stiffness * (_elastic(curvatures, locking) + stress)


def kept_curvature(friction: float, locking: float = 0.0) -> float:
    """Return the curvature [1/m] that stays after a DLO was bent far; parameters as of `bending_moments`."""
    curvatures = np.linspace(0, friction, 1001)
    return float(np.interp(friction, _elastic(curvatures, locking), curvatures))


def _elastic(curvatures: Floats, locking: float) -> Floats:
    """Return the elastic moments at (m,) curvatures [1/m], relative to EI."""
    return np.asarray((1 + np.minimum((locking * curvatures)**2, MOST_LOCKED)) * curvatures)
