# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluate parameter sets on all trials: on threads, in a process for PyBullet or on a cluster; residuals."""

from dlo_calibration.evaluation.batch import BatchEvaluator
from dlo_calibration.evaluation.cluster import ClusterExecutor
from dlo_calibration.evaluation.evaluation import Evaluation, Evaluator
from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.log import EvaluationLog, Memory
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.evaluation.process_simulator import ProcessSimulator
from dlo_calibration.evaluation.residuals import Huber, ResidualLayout

__all__ = ['BatchEvaluator', 'ClusterExecutor', 'Evaluation', 'EvaluationLog', 'Evaluator', 'Huber',
           'Linearisation', 'Memory', 'Pool', 'ProcessSimulator', 'ResidualLayout', 'Threads']
