# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""From trials to a parameter set: `calibrate`, its stages, options, engines and result."""

from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult, ParameterEstimate

__all__ = ['CalibrationResult', 'Options', 'ParameterEstimate', 'make_simulator']
