# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Everything that a user of the node `calibrator` can set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dlo_calibration.calibration.options import declared, DeclaredOptions, MACHINE, Options
from dlo_calibration.planning.options import AdviceOptions


@dataclass(frozen=True)
class CalibratorOptions(Options, AdviceOptions):
    """Everything that a user of the node can set: options of the calibration, and of the advice."""

    resume: str = declared(
        '', 'folder of a session that was interrupted, even by a crash: its messages come first, as if they '
        'were sent again; relative to the working directory; empty: begin without trials', of=MACHINE)

    @property
    def of_calibration(self) -> Options:
        """Those of the calibration alone, which sessions record."""
        return Options.of(_some(self, Options))

    @property
    def of_advice(self) -> AdviceOptions:
        """Those of the advice alone."""
        return AdviceOptions.of(_some(self, AdviceOptions))


def _some(options: DeclaredOptions, kind: type[DeclaredOptions]) -> dict[str, Any]:
    values = options.flat()
    return {declaration.name: values[declaration.name] for declaration in kind.declarations()}
