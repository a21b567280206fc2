# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The stages up to the examination, with a search and an engine that a test has made."""

from dlo_calibration.calibration.fit import fit
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.prior import Prior
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.calibration.stages import examined
from dlo_calibration.search import Hints


def fitted(trials, space, simulator, search, *, budget=150, seed=1, **rest):
    """Return the result of a search that knows no prior; `rest` is of `Setting`."""
    setting = Setting(tuple(trials), Options(seed=seed, evaluations=budget), simulator, **rest)
    findings = examined(setting, fit(setting, space, search, budget))
    return CalibrationResult.of(setting, Prior(space, Hints.none(space.dimension)), findings)
