# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A calibration under way and its folder; command line, node and capture page are three callers of it.

`source` reads a session or a request, `worker` calibrates in a thread, and `folder` has the input and the log
of a calibration until its result is complete, then the files of the result; `validation` tries a result on
other trials, and `check` tells whether they show the same DLO.  `next_action` advises what hands do next.
"""
