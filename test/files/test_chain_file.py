# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Chains in files of their own: the same again, and one sentence for what is none."""

import numpy as np
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.files.chain_file import read_chain_file, write_chain
from dlo_calibration.model.chain import Chain

CHAIN = Chain(np.random.default_rng(1).normal(0, 0.1, (9, 3)))


@pytest.mark.parametrize('name', ['chain.csv', 'chain.XML', 'chain'])
def test_a_chain_is_the_same_again(tmp_path, name):
    write_chain(tmp_path / name, CHAIN)
    np.testing.assert_array_equal(read_chain_file(tmp_path / name).points, CHAIN.points)


@pytest.mark.parametrize('name, octets, text', [
    ('a.csv', b'0,0,0\n1,0\n', 'line 2'), ('a.csv', b'', '0 point'), ('a.csv', b'\xff\xfe\0', 'line 1'),
    ('a.csv', b'0,0,0\n' * 5, 'coincident'), ('a.csv', b'nan,0,0\n1,1,1\n2,2,2\n', 'NaN'),
    ('a.csv', b'\n' * 2**21, 'more than 1048576 bytes'), ('a.csv', b'1,1,1\n' * 1001, '1001 points'),
    ('a.csv', b'1' * 10**6 + b',1,1\n', 'line 1'),
    ('a.xml', b'0,0,0\n', 'XML'), ('a.xml', b'<dlo version="1"/>', 'point_chain'),
    ('a.xml', b'<point_chain version="1"><point x="1" y="1" z="1"/></point_chain>', 'point'),
])
def test_a_file_without_a_chain_is_refused(tmp_path, name, octets, text):
    (tmp_path / name).write_bytes(octets)
    with pytest.raises(InputError) as caught:
        read_chain_file(tmp_path / name)
    assert text in str(caught.value)
    assert str(tmp_path) in str(caught.value) or name in str(caught.value)
