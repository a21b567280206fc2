# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a beginner types first is answered with what to type instead."""

from pathlib import Path

import pytest

from dlo_calibration.cli.main import main

SAMPLES = Path(__file__).resolve().parents[2] / 'msg_samples'
SESSION, RESULT = str(SAMPLES / 'object1'), str(SAMPLES / 'xml/dlo.xml')


@pytest.mark.parametrize('words, remedy', [
    ([], 'expected one of capture, trace,'), (['fit', 'nowhere'], 'No such file or directory'),
    (['fit', str(SAMPLES / 'photographs/first.jpg')], 'or an XML request (.xml)'),
    (['fit', SESSION, '--output', RESULT], 'a file of this name; expected a folder'),
    *((words, 'name RESULT.xml and SESSION in the other order') for words in (
        ['validate', SESSION, RESULT], ['simulate', SESSION, RESULT], ['plot', RESULT, SESSION]))])
def test_the_answer_is_one_sentence_with_the_remedy(words, remedy, capsys):
    assert main(words) == 2
    output, errors = capsys.readouterr()
    assert output == '' and errors.count('\n') == 1 and remedy in errors
