# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameters: the paper's 0..100 scale and the physical quantity behind each.

Everything inside the package is in SI units; 0..100 exists here and at the
edges (messages, files, tables).  Adding a parameter is one entry of PARAMETERS;
an engine reads its physical value by name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats

SCALE = 100.0
GRAVITY = 9.81  # m/s^2
ASSUMED_DENSITY = 0.05  # kg/m, of a DLO whose mass is not known
PER_WEIGHT = 'per N/m'  # end of the unit of what is divided by the weight per length


@dataclass(frozen=True)
class Parameter:
    """
    One parameter of a DLO, on a scale from 0 to 100.

    :param at_zero: physical value at 0.
    :param at_hundred: physical value at 100.
    :param default: value on the 0..100 scale where it is not calibrated.
    :param linear: True where the scale is linear, else it is logarithmic.
    :param neutral: exact physical value at the default, for a parameter that has no effect
        there (1 for a ratio; 0, which a logarithmic scale does not have).
    :param per_weight: True if motion under gravity depends only on the ratio of this
        parameter to the DLO's weight; without a known mass, that ratio is reported.
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

    def physical(self, value: float) -> float:
        """Physical value of `value` on the 0..100 scale."""
        if self.neutral is not None and value == self.default:
            return self.neutral
        if self.linear:
            return self.at_zero + (self.at_hundred - self.at_zero) * value / SCALE
        return self.at_zero * math.pow(self.at_hundred / self.at_zero, value / SCALE)

    def value(self, physical: float) -> float:
        """Value on the 0..100 scale (beyond it too) of a physical value; > 0 on a logarithmic one."""
        if physical == self.neutral:
            return self.default
        if self.linear:
            return SCALE * (physical - self.at_zero) / (self.at_hundred - self.at_zero)
        return SCALE * math.log(physical / self.at_zero) / math.log(self.at_hundred / self.at_zero)


MOST_PARTS = 8  # of a DLO, that have a bending stiffness of their own


def part_name(part: int) -> str:
    """Name the parameter of a part of the DLO, counted from 1; the first has `flexibility`."""
    return 'flexibility' if part == 1 else f'stiffness_{part}'


#: The paper's four, then what is fixed by default.
PARAMETERS: tuple[Parameter, ...] = (
    Parameter('flexibility', 'bending stiffness EI', 'N m^2', 10**-1.0, 10**-5.5, 50.0,
              'how easily the DLO bends', per_weight=True),
    Parameter('elasticity', 'stretching stiffness EA', 'N', 1e4, 1e0, 25.0,
              'how easily the DLO stretches', per_weight=True),
    Parameter('friction', 'Coulomb friction coefficient', '1', 10**-2.0, 10**0.3, 70.0,
              'friction of the DLO with the table and with itself'),
    Parameter('self_collision', 'self-collision radius', 'm', 2e-3, 3e-2, 25.0,
              'radius of the DLO where it touches itself'),
    Parameter('damping', 'drag per mass', '1/s', 1e-2, 1e2, 50.0,
              'how fast drag in the air slows the DLO'),
    Parameter('internal_damping', 'stiffness-proportional damping', 's', 1e-3, 1e-1, 0.0,
              'how fast bending and stretching vibrations fade (no effect below 0.6 time steps)'),
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
    *(Parameter(part_name(part), f'bending stiffness of part {part} relative to part 1', '1', 0.02, 50.0,
                50.0, f'how stiff part {part} of the DLO is (see parts)', neutral=1.0)
      for part in range(2, MOST_PARTS + 1)),
)
BY_NAME: Mapping[str, Parameter] = {parameter.name: parameter for parameter in PARAMETERS}
PART_NAMES = tuple(part_name(part) for part in range(2, MOST_PARTS + 1))
PAPER_PARAMETERS = ('flexibility', 'elasticity', 'friction', 'self_collision')


@dataclass(frozen=True)
class ParameterSpace:
    """
    Which parameters a calibration finds, and where the others stay.

    The DLO has as many parts of equal length as the highest `stiffness_...` that is
    free or fixed says; one, where there is none.

    :param free: names of the parameters to find, in order.
    :param fixed: values of others on the 0..100 scale; those not named keep
        their default.
    :param mass: kg of the whole DLO; 0 where it is not known.
    """

    free: tuple[str, ...] = PAPER_PARAMETERS
    fixed: Mapping[str, float] = field(default_factory=dict)
    mass: float = 0.0

    def __post_init__(self) -> None:
        free = tuple(self.free)
        for name in (*free, *self.fixed):
            if name not in BY_NAME:
                raise InputError('parameter', repr(name), f'one of {", ".join(BY_NAME)}',
                                 'correct the name')
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
    def parts(self) -> int:
        """Number of parts of the DLO that have a bending stiffness of their own."""
        return max((part for part in range(1, MOST_PARTS + 1)
                    if part == 1 or part_name(part) in (*self.free, *self.fixed)))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The entries of the table that this DLO has: all but those of parts that it has not."""
        absent = PART_NAMES[self.parts - 1:]
        return tuple(parameter for parameter in PARAMETERS if parameter.name not in absent)

    def divided(self, parts: int) -> ParameterSpace:
        """
        Return the space of a DLO of that many parts of equal length.

        Where `flexibility` is free, so is the stiffness of every other part.
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
        """Return the space with every part cut in two, and its point that is the same DLO as a (d,) point."""
        space = self.divided(2 * self.parts)
        values = {**self.fixed, **self.values(point)}
        for part in range(2, space.parts + 1):
            whole = part_name((part + 1) // 2)  # the first has no ratio: it is the measure
            values[part_name(part)] = BY_NAME[part_name(part)].default if whole == 'flexibility' else \
                self.fixed.get(whole, self.values(point).get(whole, BY_NAME[whole].default))
        return space, space.point(values)

    @property
    def mass_known(self) -> bool:
        """Tell whether physical values can be given in absolute units."""
        return self.mass > 0 or 'mass' in self.free or 'mass' in self.fixed

    def values(self, point: Sequence[float] | Floats) -> dict[str, float]:
        """Return the free parameters, 0..100, of a (d,) point of the unit cube."""
        return {name: float(u) * SCALE for name, u in zip(self.free, point, strict=True)}

    def point(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the (d,) point of the unit cube of free parameters on 0..100."""
        return np.array([values[name] / SCALE for name in self.free])

    def default_point(self) -> NDArray[np.float64]:
        """Return the (d,) point of the unit cube where nothing is found: what is fixed, else the default."""
        return self.point({name: self.fixed.get(name, BY_NAME[name].default) for name in self.free})

    def physical(self, values: Mapping[str, float], length: float) -> dict[str, float]:
        """
        Return the physical value of every parameter that the DLO has, by name.

        :param values: free parameters on the 0..100 scale.
        :param length: of the DLO [m], for the mass where that is not known.
        """
        physical = {p.name: p.physical(values.get(p.name, self.fixed.get(p.name, p.default)))
                    for p in self.parameters}
        if 'mass' not in values and 'mass' not in self.fixed:
            physical['mass'] = self.mass if self.mass > 0 else ASSUMED_DENSITY * length
        return physical

    def reported(self, name: str, value: float) -> tuple[float, str]:
        """
        Return the physical value to report for `value` on 0..100, and its unit.

        Where the mass is not known, a stiffness is given divided by the DLO's
        weight per length, which is what gravity-driven motion determines.
        """
        parameter = BY_NAME[name]
        physical = parameter.physical(value)
        if parameter.per_weight and not self.mass_known:
            return physical / (ASSUMED_DENSITY * GRAVITY), f'{parameter.unit} {PER_WEIGHT}'
        return physical, parameter.unit
