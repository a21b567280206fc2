# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's experiment: measures how consistent and how valid the found parameters are."""

from dlo_calibration.experiment.journal import Journal
from dlo_calibration.experiment.study import Outcome, Study, Subject, Task

__all__ = ['Journal', 'Outcome', 'Study', 'Subject', 'Task']
