# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Command lines that start no processes, which take a second each; a session cannot ask for that."""


def serial(words):
    """Return the words of a command line, with one worker for `fit` unless they name a number."""
    words = [str(word) for word in words]
    return words if words[:1] != ['fit'] or '--workers' in words else [*words, '--workers', '1']
