# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Samples: the folder of the sessions that ship with the package."""

from __future__ import annotations

import os
from pathlib import Path
import sys

from dlo_calibration.errors import InputError


def samples() -> Path:
    """Return the folder of the sample sessions, in the sources or where they are installed."""
    beside = Path(__file__).resolve().parents[2] / 'msg_samples'
    shared = Path('share') / 'dlo_calibration' / 'msg_samples'
    prefixes = [sys.prefix, *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    for folder in (beside, *(Path(prefix) / shared for prefix in prefixes if prefix)):
        if folder.is_dir():
            return folder
    raise InputError('samples', 'no folder msg_samples', f'{beside} or $AMENT_PREFIX_PATH/{shared}',
                     'install the package with its samples, or name a session')
