# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameter sets evaluated on all trials, in this process, others or a cluster; and their residuals.

A name is imported when it is first used, so that processes can start before NumPy is loaded.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from dlo_calibration.evaluation.apart import SimulatorApart
    from dlo_calibration.evaluation.batch import BatchEvaluator
    from dlo_calibration.evaluation.cluster import ClusterExecutor
    from dlo_calibration.evaluation.evaluation import Evaluation
    from dlo_calibration.evaluation.evaluator import Evaluator
    from dlo_calibration.evaluation.linearisation import Linearisation
    from dlo_calibration.evaluation.log import EvaluationLog
    from dlo_calibration.evaluation.memory import Memory
    from dlo_calibration.evaluation.processes import ProcessExecutor
    from dlo_calibration.evaluation.residuals import ResidualLayout
    from dlo_calibration.evaluation.robust import Huber

__all__ = ['BatchEvaluator', 'ClusterExecutor', 'Evaluation', 'EvaluationLog', 'Evaluator', 'Huber',
           'Linearisation', 'Memory', 'ProcessExecutor', 'ResidualLayout', 'SimulatorApart']

_MODULE_OF = {
    'BatchEvaluator': 'batch', 'ClusterExecutor': 'cluster', 'Evaluation': 'evaluation',
    'EvaluationLog': 'log', 'Evaluator': 'evaluator', 'Huber': 'robust', 'Linearisation': 'linearisation',
    'Memory': 'memory', 'ProcessExecutor': 'processes', 'ResidualLayout': 'residuals',
    'SimulatorApart': 'apart'}


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f'{__name__}.{_MODULE_OF[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
