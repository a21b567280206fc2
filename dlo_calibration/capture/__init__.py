# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Capture: the project of photographs, trials and hands that a person makes.

What the person enters is a `document`, with the steps of the `hands`, kept in the folder of a `project`.
`measurement` reads its photographs, `trials` drafts and writes its trials, with their `trial_warnings`.
"""

__all__: list[str] = []
