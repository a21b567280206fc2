# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Draws: DLOs whose parameters are drawn from the posterior of a result, for domain randomisation."""

from __future__ import annotations

import csv
from dataclasses import replace
import io
from typing import Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import Description
from dlo_calibration.inference.uncertainty import NOT_IDENTIFIABLE
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.planning.dlo import Posterior

MOST = 10000
RADIUS = 'self_collision'
DRAWN = 'this draw'  # in place of a verdict: the value is one of those in the interval


def drawn_dlos(dlo: Description, chain: Chain, options: Options, count: int, seed: int, *,
               vary: bool = False) -> list[Description]:
    """
    Return DLOs with parameters drawn from the joint posterior; the correlations are kept.

    :param chain: where the DLO lies; its height bounds the radius, see `Posterior.lying`.
    :param vary: whether parameters that the trials do not determine vary evenly over their interval, which is
        the whole scale where nothing is known; else they keep their values.
    :raises InputError: if there are no draws, or too many; or the seed is negative.
    """
    if not 1 <= count <= MOST:
        raise InputError('--draws', str(count), f'1 to {MOST}', 'correct it')
    if seed < 0:
        raise InputError('--seed', str(seed), '0 or more', 'correct it')
    names = dlo.space.free
    open_ones = np.array([dlo.parameters[name].verdict == NOT_IDENTIFIABLE for name in names])
    posterior = Posterior.of(dlo).lying(chain, options)
    values, highest = posterior.drawn_values(count, seed), np.full(len(names), np.inf)
    if RADIUS in names and np.isfinite(posterior.thickest):
        highest[names.index(RADIUS)] = max(BY_NAME[RADIUS].value(posterior.thickest), 0.0)
    values[:, open_ones] = posterior.values[open_ones]
    if vary:
        from scipy.special import ndtr  # slow to load

        lower, upper = (np.array([getattr(dlo.parameters[name], end) for name in names])
                        for end in ('lower', 'upper'))
        share = ndtr(posterior.standard_draws(count, seed))
        values[:, open_ones] = (lower + share * (np.minimum(upper, highest) - lower))[:, open_ones]
    values = np.minimum(values, highest)
    return [replace(dlo, parameters={
        name: replace(dlo.parameters[name], value=value, physical_value=dlo.space.reported(name, value)[0],
                      verdict=dlo.parameters[name].verdict if kept else DRAWN)
        for name, value, kept in zip(names, row, open_ones & (not vary), strict=True)})
        for row in values.tolist()]


def draws_table(drawn: Sequence[Description], files: Sequence[str]) -> str:
    """Return a CSV table: for each file its parameters, on the 0..100 scale and in physical units."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(['file', *(head for name, estimate in drawn[0].parameters.items()
                               for head in (name, f'{name} [{estimate.physical_unit}]'))])
    for file, dlo in zip(files, drawn, strict=True):
        writer.writerow([file, *(value for estimate in dlo.parameters.values()
                                 for value in (estimate.value, estimate.physical_value))])
    return stream.getvalue()
