# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Every Python file of the repository begins with the licence header."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ('benchmark', 'config', 'dlo_calibration', 'doc', 'examples', 'launch', 'msg_samples', 'test')
FILES = sorted([*ROOT.glob('*.py'), *(file for name in FOLDERS for file in (ROOT / name).rglob('*.py'))])

HEADER = """\
# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""


@pytest.mark.parametrize('path', FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_file_begins_with_the_licence_header(path):
    text = path.read_text(encoding='utf-8').removeprefix('#!/usr/bin/env python3\n')
    assert text.startswith(HEADER), 'copy the first lines of setup.py'


def test_licence_is_the_one_that_the_header_names():
    first, second = (ROOT / 'LICENSE').read_text(encoding='utf-8').split('\n')[1:3]
    assert first.strip() == 'Apache License'
    assert second.strip() == 'Version 2.0, January 2004'
