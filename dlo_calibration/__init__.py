# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Find the physical parameters of a rope, cable, wire or hose from observed manipulations.

Names are imported when they are first used, so that a program which starts from
this package, such as the node, can listen to signals before NumPy is loaded.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from dlo_calibration.calibration.calibrate import calibrate
    from dlo_calibration.calibration.result import CalibrationResult
    from dlo_calibration.errors import DloCalibrationError, InputError, SimulationError
    from dlo_calibration.evaluation.evaluation import Evaluation
    from dlo_calibration.model.action import Action, Hand
    from dlo_calibration.model.chain import Chain
    from dlo_calibration.model.parameters import Parameter, PARAMETERS, ParameterSpace
    from dlo_calibration.model.trial import Goal, Trial
    from dlo_calibration.simulation.protocol import Rollout, Simulator

__all__ = [
    'PARAMETERS', 'Action', 'CalibrationResult', 'Chain', 'DloCalibrationError', 'Evaluation', 'Goal',
    'Hand', 'InputError', 'Parameter', 'ParameterSpace', 'Rollout', 'SimulationError', 'Simulator',
    'Trial', 'calibrate',
]

_HOMES = {
    'model.action': ('Action', 'Hand'),
    'calibration.calibrate': ('calibrate',),
    'calibration.result': ('CalibrationResult',),
    'model.chain': ('Chain',),
    'errors': ('DloCalibrationError', 'InputError', 'SimulationError'),
    'evaluation.evaluation': ('Evaluation',),
    'model.parameters': ('PARAMETERS', 'Parameter', 'ParameterSpace'),
    'simulation.protocol': ('Rollout', 'Simulator'),
    'model.trial': ('Goal', 'Trial'),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f'{__name__}.{_HOME[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
