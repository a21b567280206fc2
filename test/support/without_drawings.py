# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pages without what takes long, for tests of something else: a drawing takes a tenth of a second."""

from concurrent.futures import ThreadPoolExecutor

from dlo_calibration.calibration import stages
from dlo_calibration.report import bending_drawing, figure, landscape
from dlo_calibration.report.figure import Panel
from dlo_calibration.workspace import report_writer


def leave_out_drawings(replace=setattr):
    """Let the page of a result have its words only; `replace` sets an attribute of a module."""
    # A thread in place of a process, in which drawings could not be left out.
    replace(report_writer, 'ProcessPoolExecutor', lambda *_: ThreadPoolExecutor(1))
    replace(report_writer, 'films', lambda *_: {})
    for module in (bending_drawing, figure, landscape):
        replace(module, 'panel', lambda draw, words, legend=True: Panel('data:,', words))


def leave_out_slices(replace=setattr):
    """Let no slices be simulated, which takes the more time the more there is."""
    replace(stages, 'simulate_slices', lambda *_, **__: None)
