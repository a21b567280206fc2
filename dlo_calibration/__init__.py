# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Find the physical parameters of a rope, cable, wire or hose from observed manipulations.

The public interface is what `__all__` lists. A name is imported when it is first used, so that a
program which starts from this package, such as the node, can listen to signals before NumPy is
loaded, and so that nobody loads PyBullet who does not use it.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from dlo_calibration.calibration.calibrate import calibrate
    from dlo_calibration.calibration.options import Options
    from dlo_calibration.errors import DloCalibrationError, InputError, SimulationError
    from dlo_calibration.evaluation.log import EvaluationLog
    from dlo_calibration.export.mjcf import export_mjcf
    from dlo_calibration.export.sdf import export_sdf
    from dlo_calibration.export.usd import export_usd
    from dlo_calibration.files.result import read_result
    from dlo_calibration.files.session import read_session
    from dlo_calibration.model.action import Action, Hand
    from dlo_calibration.model.chain import Chain
    from dlo_calibration.model.trial import Goal, Trial
    from dlo_calibration.planning.options import PlanOptions
    from dlo_calibration.planning.planner import plan
    from dlo_calibration.planning.prediction import simulate
    from dlo_calibration.simulation.bullet import BulletRope

__all__ = [
    'Action', 'BulletRope', 'Chain', 'DloCalibrationError', 'EvaluationLog', 'Goal', 'Hand',
    'InputError', 'Options', 'PlanOptions', 'SimulationError', 'Trial', 'calibrate', 'export_mjcf',
    'export_sdf', 'export_usd', 'plan', 'read_result', 'read_session', 'simulate',
]

_MODULES = {
    'model.action': ('Action', 'Hand'),
    'model.chain': ('Chain',),
    'model.trial': ('Goal', 'Trial'),
    'calibration.options': ('Options',),
    'calibration.calibrate': ('calibrate',),
    'planning.options': ('PlanOptions',),
    'planning.planner': ('plan',),
    'planning.prediction': ('simulate',),
    'evaluation.log': ('EvaluationLog',),
    'export.mjcf': ('export_mjcf',),
    'export.sdf': ('export_sdf',),
    'export.usd': ('export_usd',),
    'files.session': ('read_session',),
    'files.result': ('read_result',),
    'simulation.bullet': ('BulletRope',),
    'errors': ('DloCalibrationError', 'InputError', 'SimulationError'),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f'{__name__}.{_MODULE_OF[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
