# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rungs: candidates of a plan are compared with few nodes and long steps before the default ones decide."""

from __future__ import annotations

from dataclasses import replace

from dlo_calibration.calibration.options import Options

SHARE = 3 / 4  # of the segments and of the steps; with less, plans end further from their goals
LEAST_NODES = 21  # of a coarse DLO
LONGEST_STEP = 0.01  # s, of a coarse simulation


def coarser(options: Options) -> Options:
    """Return options with SHARE of the segments and of the time steps, within limits."""
    nodes = max(round(SHARE * (options.nodes - 1)) + 1, LEAST_NODES)
    step = min(options.time_step / SHARE, LONGEST_STEP)
    return replace(options, nodes=min(options.nodes, nodes), time_step=max(options.time_step, step))
