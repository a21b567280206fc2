# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
What a person reads: sentences, tables, pictures and the page of a result.

Sentences are in `sentences`, tables in `terminal`, pictures in `drawing` and `animation`, the page in `page`.
They are imported where they are used, as Matplotlib, Rich and Jinja2 take long to load.
"""
