# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The files of predictions: what `simulate --output` writes into a folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Mapping, Sequence

from dlo_calibration.files.chain_file import write_chain
from dlo_calibration.model.chain import Chain
from dlo_calibration.planning.prediction import Prediction
from dlo_calibration.simulation.protocol import Simulator
from dlo_calibration.writing import Attempts, whole

ALL = 'simulation.json'


def write_prediction_files(folder: Path, predictions: Sequence[tuple[str, Prediction]],
                           about: Mapping[str, Any], simulator: Simulator) -> None:
    """
    Write predictions to a folder, as far as possible.

    :param predictions: names of trials, which can be anything, and what happens in them.
    :param about: the same, as plain values.
    :raises DloCalibrationError: if files cannot be written; the others are.
    """
    from dlo_calibration.report.prediction_drawing import (
        write_prediction_animation,
        write_prediction_picture,
    )

    attempts = Attempts(folder)
    with attempts.attempt(ALL), whole(folder / ALL) as new:
        new.write_text(f'{json.dumps(about, indent=2, allow_nan=False)}\n', encoding='utf-8')
    for k, (name, one) in enumerate(predictions, start=1):
        for number, step in enumerate(one.steps, start=1):
            for suffix in ('csv', 'xml'):
                file = f'trial_{k}_after_{number}.{suffix}'
                with attempts.attempt(file):
                    write_chain(folder / file, Chain(step.chain))
        with attempts.attempt(f'trial_{k}.png'):
            write_prediction_picture(one, name, folder / f'trial_{k}.png')
        with attempts.attempt(f'trial_{k}.gif'):
            write_prediction_animation(one, name, simulator, folder / f'trial_{k}.gif')
    attempts.require()
