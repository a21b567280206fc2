# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Files that are written and read: sessions, requests, results."""

from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.request import read_request, write_request
from dlo_calibration.files.result import Description, read_result, write_result
from dlo_calibration.files.session import read_session, Session

__all__ = ['Description', 'Session', 'SessionWriter', 'read_request', 'read_result', 'read_session',
           'write_request', 'write_result']
