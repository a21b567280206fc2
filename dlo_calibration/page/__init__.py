# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Page: the server of the verb `capture`, and the page in the browser (`static`) that it serves.

`server` answers requests, behind `guard`, and sends events to the open pages; `studio` is all that the page
can ask for.  aiohttp is loaded only here.
"""

__all__: list[str] = []
