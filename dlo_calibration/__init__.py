# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Find the physical parameters of a rope, cable, wire or hose from observed manipulations.

The public interface is what `__all__` lists.  A name is imported when it is first used, so that a program
that starts from this package, such as the node, can listen to signals before NumPy is loaded, and so that
PyBullet is loaded only by those who use it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # for type checkers and editors
    from dlo_calibration.calibration.calibrate import calibrate as calibrate
    from dlo_calibration.calibration.options import Options as Options
    from dlo_calibration.errors import DloCalibrationError as DloCalibrationError
    from dlo_calibration.errors import InputError as InputError
    from dlo_calibration.errors import SimulationError as SimulationError
    from dlo_calibration.evaluation.log import EvaluationLog as EvaluationLog
    from dlo_calibration.export.mjcf import export_mjcf as export_mjcf
    from dlo_calibration.export.sdf import export_sdf as export_sdf
    from dlo_calibration.export.usd import export_usd as export_usd
    from dlo_calibration.files.result import read_result as read_result
    from dlo_calibration.files.session import read_session as read_session
    from dlo_calibration.model.action import Action as Action
    from dlo_calibration.model.action import Hand as Hand
    from dlo_calibration.model.chain import Chain as Chain
    from dlo_calibration.model.trial import Goal as Goal
    from dlo_calibration.model.trial import Trial as Trial
    from dlo_calibration.planning.options import PlanOptions as PlanOptions
    from dlo_calibration.planning.planner import plan as plan
    from dlo_calibration.planning.prediction import simulate as simulate
    from dlo_calibration.simulation.bullet import BulletRope as BulletRope

#: The same names, with their modules, for when a program uses them.
_MODULES = {
    'Action': 'model.action',
    'BulletRope': 'simulation.bullet',
    'Chain': 'model.chain',
    'DloCalibrationError': 'errors',
    'EvaluationLog': 'evaluation.log',
    'Goal': 'model.trial',
    'Hand': 'model.action',
    'InputError': 'errors',
    'Options': 'calibration.options',
    'PlanOptions': 'planning.options',
    'SimulationError': 'errors',
    'Trial': 'model.trial',
    'calibrate': 'calibration.calibrate',
    'export_mjcf': 'export.mjcf',
    'export_sdf': 'export.sdf',
    'export_usd': 'export.usd',
    'plan': 'planning.planner',
    'read_result': 'files.result',
    'read_session': 'files.session',
    'simulate': 'planning.prediction',
}
__all__ = list(_MODULES)


if not TYPE_CHECKING:  # for whom it would make every name one of this package
    def __getattr__(name):
        if name in _MODULES:
            return getattr(import_module(f'{__name__}.{_MODULES[name]}'), name)
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
