# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Every Python file of the repository begins with the licence header."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ('benchmark', 'config', 'dlo_calibration', 'doc', 'examples', 'launch', 'msg_samples', 'test')
FILES = sorted([*ROOT.glob('*.py'), *(file for name in FOLDERS for file in (ROOT / name).rglob('*.py'))])

HEADER = """\
# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0
"""


def beginning(file):
    return file.read_text(encoding='utf-8').removeprefix('#!/usr/bin/env python3\n')


def test_files_begin_with_the_licence_header():
    """The first lines of setup.py are the ones to copy."""
    without = [str(file.relative_to(ROOT)) for file in FILES if not beginning(file).startswith(HEADER)]
    assert not without


def test_licence_is_the_one_that_the_header_names():
    first, second = (ROOT / 'LICENSE').read_text(encoding='utf-8').split('\n')[1:3]
    assert first.strip() == 'Apache License'
    assert second.strip() == 'Version 2.0, January 2004'
