# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's experiment: the consistency and the validity of calibrated parameters."""

from dlo_calibration.experiment.journal import Journal, Laboratory
from dlo_calibration.experiment.study import Outcome, Study, Subject, Task

__all__ = ['Journal', 'Laboratory', 'Outcome', 'Study', 'Subject', 'Task']
