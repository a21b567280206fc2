# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rows: the parameters of a result as texts of a table; a knot of the rest shape is one row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

from dlo_calibration.model.parameters import BY_NAME, knot_names, ParameterSpace
from dlo_calibration.model.quantity import interval, measured, number


@dataclass(frozen=True)
class Row:
    """
    One parameter in words, or both components of the curvature at a knot.

    :param name: for people; that of a knot names both components.

    :param value: on the 0..100 scale, with its interval `ends`.
    :param physical: the same in physical units, with its interval `physical_ends`.
    :param verdict: of the less certain component.
    :param note: a remark; may be empty.
    """

    name: str
    quantity: str
    value: str
    ends: str
    physical: str
    physical_ends: str
    verdict: str
    note: str


def parameter_rows(parameters: Mapping[str, Mapping[str, Any]], space: ParameterSpace) -> list[Row]:
    """Return the rows for the parameters in the plain values of a result."""
    rows, names = [], knot_names(space.knots)
    pairs = dict(zip(names[::2], names[1::2], strict=True))
    for name, one in parameters.items():
        if name in pairs and pairs[name] in parameters:
            place = number(100 * (int(name[-1]) - 1) / (space.knots - 1))
            rows.append(_knot(f'rest_curvature {name[-1]}', f'at {place} % of the length, x and y',
                              one, parameters[pairs[name]]))
        elif not any(name == second and first in parameters for first, second in pairs.items()):
            unit = one['physical_unit']
            rows.append(Row(
                name, BY_NAME[name].quantity, number(one['value']), interval(one['lower'], one['upper'], '1'),
                measured(one['physical_value'], unit),
                BY_NAME[name].interval(one['lower'], one['upper'],
                                       (one['physical_lower'], one['physical_upper']), unit),
                one['verdict'], one['note']))
    return rows


def _knot(name: str, quantity: str, *pair: Mapping[str, Any]) -> Row:
    unit = pair[0]['physical_unit']

    def ends(prefix: str) -> str:
        """Return how far the intervals reach, to the wider side."""
        return ', '.join(f'±{number(max(one[f"{prefix}upper"] - value, value - one[f"{prefix}lower"]))}'
                         for one in pair for value in (one[f'{prefix}value'],))

    x, y = pair
    return Row(
        name, quantity, f'{number(x["value"])}, {number(y["value"])}', ends(''),
        f'{number(x["physical_value"])}, {measured(y["physical_value"], unit)}',
        f'{ends("physical_")} {unit}',
        max(pair, key=lambda one: float(one['std']))['verdict'],
        '; '.join(dict.fromkeys(one['note'] for one in pair if one['note'])))
