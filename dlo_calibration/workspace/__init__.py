# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A calibration under way and its folder; command line, node and capture page are three callers of it.

`source` reads a session or a request, `worker` calibrates in a thread, and `folder` has the input and the log
of a calibration until its result is complete, then the files of the result; `validation` tries a result on
other trials, and `check` tells whether they show the same DLO.  `next_action` advises what hands do next.
"""

from dlo_calibration.workspace.folder import CalibrationFolder
from dlo_calibration.workspace.source import read_source, Selection, Source
from dlo_calibration.workspace.worker import Progress, Worker

__all__ = ['CalibrationFolder', 'Progress', 'Selection', 'Source', 'Worker', 'read_source']
