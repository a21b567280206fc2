# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded input messages are decoded and encoded without a loss."""

import pytest

from dlo_calibration.files.record import decode, DEFINITIONS, encode, input_types, typestore
from dlo_calibration.files.session import read_session, samples
from dlo_calibration.messages.codec import INPUT_TYPES, TRIAL_TYPES


def test_inputs_that_are_decoded_and_encoded_have_the_same_bytes():
    records = [record for record in read_session(samples() / 'object1').records
               if record.type in TRIAL_TYPES.values()]
    assert {record.type for record in records} == {*TRIAL_TYPES.values()}
    for record in records:
        assert encode(decode(record), record.type) == bytes(record.data)


@pytest.mark.parametrize('name', DEFINITIONS)
def test_definitions_of_inputs_are_those_of_jazzy(name):
    assert input_types().hash_rihs01(name) == typestore().hash_rihs01(name)
    assert input_types().generate_msgdef(name) == typestore().generate_msgdef(name)


def test_every_input_is_defined():
    assert {*INPUT_TYPES.values()} <= {*DEFINITIONS}
