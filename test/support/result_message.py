# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Reads what a `result` message says about the parameters."""

from dlo_calibration.ros.diagnostics import WHOLE


def result_values(message):
    """Read the parameters of a `result` message: name -> key -> number, text or bool."""
    found = {}
    for one in message.status:
        if one.name != WHOLE:
            values = {pair.key: pair.value for pair in one.values}
            found[one.name] = {
                key: value == 'true' if key == 'identifiable' else
                value if key.endswith(('unit', 'verdict', 'note')) else float(value)
                for key, value in values.items()}
    return found
