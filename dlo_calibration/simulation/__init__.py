# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A trial simulated: the protocol of an engine, the course of a rollout, and the engines."""
