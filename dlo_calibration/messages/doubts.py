# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Doubts: what is implausible about a trial, found while its messages come."""

from __future__ import annotations

from typing import Sequence

from dlo_calibration.calibration.options import Options
from dlo_calibration.messages.trial_builder import TrialBuilder
from dlo_calibration.observation.plausibility import implausible

DOUBTED = (-1, True)  # of a trial whose doubts were told


def doubts(builders: Sequence[TrialBuilder], k: int, options: Options) -> tuple[str, ...]:
    """
    Return what is implausible about the trial of builder `k`, once.

    Of a stream, it is looked at each time the number of goals has doubled, and at the first one at rest.
    """
    builder = builders[k] if k < len(builders) else None
    if builder is None or not builder.complete or builder.judged == DOUBTED or builder.unsettled(options):
        return ()
    judged = len(builder.views).bit_length(), builder.judged[1] or builder.views[-1].stable
    if judged == builder.judged:
        return ()
    builder.judged = judged
    complete = [other for other in builders[:k + 1] if other.complete]
    before = complete[-2].trial if len(complete) > 1 else None
    trial = builder.build(f'trial {len(complete)}', options)
    found = implausible(trial, options.table_height if options.table else None, bool(options.scene), before)
    if found:
        builder.judged = DOUBTED
    return found
