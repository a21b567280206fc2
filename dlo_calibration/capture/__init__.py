# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Photographs: what is seen in a photograph of a DLO on a table, and where that is in metres."""

__all__: list[str] = []
