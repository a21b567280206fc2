# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded input messages are decoded and encoded without a loss."""

from dlo_calibration.files.record import decode, encode
from dlo_calibration.files.session import read_session, samples
from dlo_calibration.messages.codec import TRIAL_TYPES


def test_inputs_that_are_decoded_and_encoded_have_the_same_bytes():
    records = [record for record in read_session(samples() / 'object1').records
               if record.type in TRIAL_TYPES.values()]
    assert {record.type for record in records} == {*TRIAL_TYPES.values()}
    for record in records:
        assert encode(decode(record), record.type) == bytes(record.data)
