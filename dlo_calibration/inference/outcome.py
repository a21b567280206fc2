# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What inference knows of a calibration."""

from __future__ import annotations

from typing import Protocol

from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.inference.examination import Examination
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial


class Calibrated(Protocol):
    """The outcome of a calibration, as far as it counts here."""

    @property
    def space(self) -> ParameterSpace:
        """Return the parameters that were found, and where the others stayed."""

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Return what it was calibrated on."""

    @property
    def best(self) -> Evaluation:
        """Return the evaluation that fits best."""

    @property
    def examination(self) -> Examination | None:
        """Return what was found around it; None where there was no time."""

    @property
    def std(self) -> Floats:
        """Return the (d,) standard deviations of the found values, in the unit cube."""

    @property
    def seconds(self) -> float:
        """Return how long it took."""
