# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The result for a reader: sentences, tables, pictures and the page.

Sentences are in `sentences`, tables in `terminal`, pictures in `drawing` and `animation`, the page in `page`.
Other modules import them only when they are needed, because Matplotlib, Rich and Jinja2 load slowly.
"""
