# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `warm-up`: what it says, and that a second time it has nothing to do."""

from pathlib import Path


def test_a_second_time_it_is_all_there(command):
    for _ in range(2):
        code, found, _ = command('warm-up', '--json')
        assert code == 0
        assert [one['name'] for one in found['compiled']] == ['simulation', 'tracer']
        assert all(list(Path(one['folder']).glob('*.nbi')) for one in found['compiled'])
    assert not any(one['compiled'] for one in found['compiled'])
