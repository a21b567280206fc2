# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Two views: the axis of a lifted DLO from two photographs of the same moment."""

from __future__ import annotations

from dlo_calibration.capture.chains import Axis
from dlo_calibration.capture.scale import Scale
from dlo_calibration.capture.trace import Trace
from dlo_calibration.errors import InputError


def axis_of_two_views(above: Trace, above_scale: Scale, side: Trace, side_scale: Scale,
                      diameter: float) -> Axis:
    """
    Return the axis of a DLO in space.

    :param above: its middle line in one photograph; `side`: in the other one, from the same end.
    :param diameter: of the DLO [m].
    :raises InputError: where the two photographs do not determine it.
    """
    raise InputError('second photograph', 'a lifted DLO', 'a DLO on the table', 'let the hand put it down')
