# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Targets: how certain a user wants the parameters to become."""

from __future__ import annotations

import math
import re
from typing import Mapping

from dlo_calibration.errors import InputError, one_of, suggestion
from dlo_calibration.inference.uncertainty import DEVIATIONS, IDENTIFIABLE_WIDTH
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace, SCALE

THING = 'parameter wanted'
SYMBOLS = {'EI': 'flexibility', 'EA': 'elasticity', 'mu': 'friction'}


def read_targets(text: str) -> Mapping[str, float]:
    """
    Return the wanted half width of the 90 % interval of each parameter, in units of a search.

    :param text: such as 'flexibility 2, friction 3' on the 0..100 scale, or 'EI 5 %' of the physical value.
    :raises InputError: if it is something else.
    """
    targets: dict[str, float] = {}
    for part in text.split(',') if text.strip() else []:
        match = re.fullmatch(r'\s*(\w+)\s+(\d{1,6}(?:\.\d{1,6})?)\s*(%?)\s*', part)
        number = float(match[2]) if match else 0.0
        if match is None or not 0 < number <= SCALE:
            raise InputError(THING, repr(part.strip()[:40]), f'a name and a number above 0 up to {SCALE:g}, '
                             'or one with %', "write it like 'flexibility 2, friction 3' or 'EI 5 %'")
        name = SYMBOLS.get(match[1], match[1])
        if name not in BY_NAME:
            raise InputError(THING, repr(name[:40]), one_of((*SYMBOLS, *BY_NAME), name),
                             suggestion(name, BY_NAME, 'correct the name'))
        if name in targets:
            raise InputError(THING, f'{name} twice', 'each name once', 'leave one of them out')
        parameter = BY_NAME[name]
        if match[3] and parameter.linear:
            raise InputError(THING, f'{part.strip()}', f'a half width of {name} on the 0..100 scale, as its '
                             'physical value may be 0', 'leave the % out')
        scale = abs(math.log(parameter.at_hundred / parameter.at_zero)) if match[3] else SCALE
        targets[name] = (math.log1p(number / 100) if match[3] else number) / scale * parameter.extent
    return targets


def wanted_deviations(text: str, space: ParameterSpace) -> Floats:
    """
    Return the standard deviations, (d,), that the free parameters shall have at most; inf: any.

    :param text: see `read_targets`; empty: each parameter shall be identifiable.
    :raises InputError: if a wanted parameter is not calibrated.
    """
    targets = read_targets(text)
    for name in targets:
        if name not in space.free:
            raise InputError(THING, name, f'parameters that are calibrated: {", ".join(space.free)}',
                             f'add {name} to calibrate, or leave it out')
    return frozen_array([targets.get(name, math.inf) / DEVIATIONS if targets else
                         IDENTIFIABLE_WIDTH / 2 / DEVIATIONS for name in space.free])
