# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The definitions of input messages are those of ROS 2 Jazzy."""

import dataclasses

import numpy as np
import pytest

from dlo_calibration.files.bag import decode, encode
from dlo_calibration.files.input_messages import DEFINITIONS, input_types
from dlo_calibration.files.intake import Record
from dlo_calibration.files.recording import typestore
from dlo_calibration.files.samples import samples
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import INPUT_TYPES


@pytest.mark.parametrize('name', DEFINITIONS)
def test_a_definition_is_that_of_jazzy(name):
    assert input_types().hash_rihs01(name) == typestore().hash_rihs01(name)
    constants, fields = input_types().fielddefs[name]
    assert (list(constants), list(fields)) == tuple(map(list, typestore().fielddefs[name]))


def test_every_input_is_defined():
    assert {*INPUT_TYPES.values()} <= {*DEFINITIONS}


def plain(value):
    """Return a message as dictionaries, lists and numbers."""
    if dataclasses.is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in dataclasses.fields(value)}
    return [plain(one) for one in value] if isinstance(value, list | np.ndarray) else value


def test_inputs_are_decoded_as_with_all_definitions():
    records = [one for one in read_session(samples() / 'object1').records if one.type in DEFINITIONS]
    assert {one.type for one in records} == {*INPUT_TYPES.values()}
    for one in records:
        expected = typestore().deserialize_cdr(one.data, one.type)
        assert plain(decode(Record(one.name, one.type, one.data, 1))) == plain(expected)
        assert encode(decode(one), one.type) == bytes(one.data)
