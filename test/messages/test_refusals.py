# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A refusal is reported in a harmless line that shortens only what came, and repeated reasons are counted."""

import copy
import pickle
import unicodedata

from hypothesis import given
from hypothesis import strategies as st
import pytest
from toy_messages import MINUTE, SECOND, session_messages, write_session
from toy_simulator import new_toy
from wrong_input import action, cloud, with_point

from dlo_calibration.calibration.options import Options
from dlo_calibration.cli.main import main
from dlo_calibration.errors import (
    InputError,
    LONGEST_TEXT,
    LONGEST_WORD,
    printable,
    safe_line,
    SimulationError,
)
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.messages.codec import ACTION, bag_types, GOAL
from dlo_calibration.messages.refusals import counted, MOST_REASONS, Refusals

TYPES = bag_types()
HOSTILE = '\x1b]0;owned\x07\x1b[2J\x9b31m‮txt.exe\r\n$ fake\ud800'


def harmless(text):
    """Tell whether a terminal only shows a text: no control, format or surrogate character, and one line."""
    return not any(unicodedata.category(character) in ('Cc', 'Cs', 'Zl', 'Zp')
                   or character in '\u202a\u202b\u202d\u202e'
                   for character in text)


def test_control_characters_are_escaped():
    assert printable('a\x1b[2Jb\x9bc\u202ed\ud800e') == r'a\x1b[2Jb\x9bc\u202ed\ud800e'
    assert printable('two\r\nlines\tand a blank') == 'two  lines and a blank'
    assert printable('flexibilité, 柔軟さ, 🪢 \u2026') == 'flexibilité, 柔軟さ, 🪢 \u2026'


@given(st.lists(st.text(max_size=400), min_size=4, max_size=4))
def test_an_error_is_one_line_of_limited_length_whatever_came(parts):
    error = InputError(*parts)
    for raised in (error, SimulationError(''.join(parts)), copy.copy(error)):
        assert len(str(raised)) <= 4 * LONGEST_TEXT + 20
        assert harmless(str(raised))


@pytest.mark.parametrize('quote', ["'", '"'])
def test_a_long_name_is_shortened_and_nothing_else(quote):
    text = str(InputError('goal_chain stamped 12.5 s', f'frame_id {quote}{50_000 * "long name "}{quote}',
                          "'world'", 'reset'))
    assert text.startswith(f'goal_chain stamped 12.5 s: frame_id {quote}long name long')
    assert text.endswith(f"name {quote}; expected 'world'; reset")
    assert '…' in text and len(text) < 180


def test_sentences_of_the_package_are_never_shortened():
    words = ' '.join(f"the hands' word {k}" for k in range(40))
    text = str(InputError(f'{words} (thing)', f"the trial's {words}", f'expected {words}', f'remedy {words}'))
    assert len(text) > 2500 and '…' not in text
    assert safe_line(f"the clamps' {words}, the trials' {words}").count(words) == 2


def test_an_error_does_not_keep_the_megabytes_that_came():
    error = InputError('thing', 5_000_000 * 'x', 'less', 'shorten it')
    assert len(error.came) <= LONGEST_WORD and len(pickle.dumps(error)) < 1000


def test_refusals_for_one_reason_are_one_line_with_the_first_stamp():
    texts = [f'goal_chain stamped {k}.5 s: NaN in point {k}' for k in range(100)]
    assert counted([*texts, "frame 'a'", "frame 'b\\'c'", 'something else']) == (
        'goal_chain stamped 0.5 s: NaN in point 0 (and 99 more like it)',
        "frame 'a' (and 1 more like it)",
        'something else')


def test_the_number_of_reported_reasons_is_limited():
    texts = [f'{"x" * k} is wrong' for k in range(1, 500)]
    assert len(counted(texts)) == MOST_REASONS + 1
    refusals = Refusals()
    for text in texts:
        refusals.add(text)
    assert len(refusals.due(0.0)) == MOST_REASONS + 1


def test_a_repeated_refusal_is_reported_at_once_then_at_growing_intervals_and_never_lost():
    refusals, reports = Refusals(), []
    for k in range(3000):  # at 10 Hz
        refusals.add(f'goal_chain stamped {k} s: bad')
        reports += [(k / 10, text) for text in refusals.due(k / 10)]
    assert reports[0] == (0.0, 'goal_chain stamped 0 s: bad')
    assert reports[1] == (1.0, 'goal_chain stamped 10 s: bad (11 times)')
    assert [round(when) for when, _ in reports] == [0, 1, 3, 7, 15, 31, 63, 123, 183, 243]
    refusals.add('another reason')
    assert refusals.due(300.0) == ['another reason']
    assert refusals.rest() == ['goal_chain stamped 2999 s: bad (3000 times)']
    assert refusals.rest() == []


def test_session_with_thousands_of_bad_messages_gives_one_line_for_each_reason(tmp_path, capsys):
    bad = [(GOAL, with_point(4, float('inf'))(TYPES)) for _ in range(300)]
    for k, (_, message) in enumerate(bad):
        message.header.stamp.sec = 200 + k
    path = write_session(tmp_path / 'session.mcap', [*session_messages(TYPES, 1), *bad])
    refusal, = session_trials(read_session(path), Options())[1]
    assert refusal.startswith('goal_chain stamped 200 s: ') and refusal.endswith(' (and 299 more like it)')
    assert main(['info', str(path)], new_toy) == 0
    assert len(capsys.readouterr().out.splitlines()) < 30


def test_hostile_names_are_only_shown(tmp_path, capsys):
    name = HOSTILE.replace('\ud800', '')  # CDR has no lone surrogates
    good = session_messages(TYPES, 1)
    for kind, message in good:
        message.header.frame_id = name
        if kind == ACTION:
            message.joint_names = [name]
    foreign = cloud(stamp=2 * MINUTE + SECOND, frame=name + 'other')(TYPES)
    far = action(stamp=2 * MINUTE + 2 * SECOND, frame=name, names=(f'{name}2',), away=5.0)(TYPES)
    path = write_session(tmp_path / f'session{name}', [*good, (GOAL, foreign), (ACTION, far)])
    for arguments in (['info', str(path)], ['fit', str(path), '--evaluations', '20', '--workers', '1'],
                      ['fit', f'{path}.mcap']):
        main(arguments, new_toy)
        shown = capsys.readouterr()
        for line in (shown.out + shown.err).split('\n'):
            assert harmless(line), repr(line)
    assert main(['info', str(path)], new_toy) == 0
    assert r'\x1b]0;owned\x07' in capsys.readouterr().out
