# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Saving: trials from photographs as files that `fit` reads, with the same numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.file_options import recordable
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.request import Request, TrialRequest
from dlo_calibration.files.request import write_request as write_document
from dlo_calibration.files.session import trial_records
from dlo_calibration.model.trial import Trial
from dlo_calibration.writing import whole


def write_session(path: Path, trials: Sequence[Trial], options: Mapping[str, Any]) -> None:
    """
    Write trials to one MCAP file, as if a robot had done them.

    :param options: by name, to be recorded.
    :raises InputError: where the file cannot be written.
    """
    with whole(path) as new, SessionWriter(new, options) as writer:
        for record in trial_records(trials):
            writer.write(record.topic, record.type, record.data, record.log_time, flush=False)


def write_request(path: Path, trials: Sequence[Trial], options: Mapping[str, Any]) -> None:
    """
    Write trials to an XML request.

    :param options: by name.
    :raises InputError: where there is no trial, or the file cannot be written.
    """
    write_document(path, Request(tuple(map(TrialRequest.of, trials)), recordable(options)))
