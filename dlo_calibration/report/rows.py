# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rows: the parameters of a result and facts about its fit as texts of tables; a knot is one row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

from dlo_calibration.model.parameters import BY_NAME, knot_names, ParameterSpace
from dlo_calibration.model.quantity import interval, measured, number
from dlo_calibration.model.score import SIMILAR, VERY_SIMILAR


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


def fit_facts(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return facts about the fit and the search, as pairs of texts, from the plain values of a result."""
    facts = [
        ('difference score', f'{number(values["score"])} cm (below {SIMILAR:g}: similar, '
                             f'below {VERY_SIMILAR:g}: very similar)'),
        ('mean error', f'{measured(values["mean_error_m"], "m")} '
                       f'({number(values["error_percent_of_length"])} % of the length)'),
        ('rms error', measured(values['rms_error_m'], 'm')),
        ('largest error', measured(values['max_error_m'], 'm')),
        ('trials', str(values['trials'])),
        ('evaluations', f'{values["evaluations"]} ({values["simulations"]} simulations) '
                        f'in {number(values["seconds"])} s'),
        ('search', f'{values["search"] or "-"}, seed {"-" if values["seed"] is None else values["seed"]}'),
        ('engine', values['engine'])]
    other = values['confirmation']
    if other is not None:
        facts.append((
            f'confirmed by {other["engine"]}',
            f'difference score {number(other["score"])} cm, '
            f'mean error {measured(other["mean_error_m"], "m")}; '
            f'points {measured(other["mean_distance_m"], "m")} from those of {values["engine"]}, '
            f'{measured(other["max_distance_m"], "m")} at most'))
    return [*facts, ('ended', values['stop_reason'])]
