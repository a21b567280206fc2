# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The passport of a result: written by a calibration, read again, and told if the engine is another one."""

from dataclasses import replace
import hashlib

import pytest
from toy_command import one_worker
from toy_messages import session_messages, write_session
from toy_simulator import new_toy

from dlo_calibration import InputError
from dlo_calibration.calibration.passport import engine_version, package_version, Passport, UNKNOWN
from dlo_calibration.cli import main as cli
from dlo_calibration.files.result import read_description, read_result, write_result
from dlo_calibration.files.session import samples
from dlo_calibration.messages.codec import bag_types

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')


@pytest.fixture
def fitted(tmp_path):
    """Give the session of a calibration, and the path of its result."""
    session = write_session(tmp_path / 'recorded.mcap', session_messages(bag_types(), 2))
    assert cli.main(one_worker(['fit', str(session), '--measured-by', 'Ada <L> & "co"',
                                '--output', str(tmp_path / 'out')]), new_toy) == 0
    return session, tmp_path / 'out' / 'result.xml'


def test_a_calibration_writes_who_measured_what_and_what_calibrated_it(fitted):
    session, path = fitted
    passport = read_result(path).passport
    assert passport.by == 'Ada <L> & "co"'
    assert passport.version == package_version()
    assert passport.engine == engine_version()
    assert passport.sessions == {session.name: hashlib.sha256(session.read_bytes()).hexdigest()}
    assert len(passport.calibrated) == 10
    assert 'Ada' in passport.words
    assert passport.warning == ''


@pytest.mark.long
def test_check_and_plan_tell_if_the_engine_is_another_one(fitted, capsys, tmp_path):
    session, path = fitted
    old = tmp_path / 'old.xml'
    result = read_result(path)
    write_result(old, replace(result, passport=replace(result.passport, engine='0000aaaa', version='0.0.1')))
    assert read_result(old).passport.engine == '0000aaaa'
    capsys.readouterr()
    assert cli.main(one_worker(['check', str(old), str(session)]), new_toy) == 0
    output, errors = capsys.readouterr()
    assert 'another version of the engine (0.0.1, engine 0000aaaa' in errors
    assert 'calibrated on' in output
    start, goal = (str(samples() / 'chains' / name) for name in ('start.csv', 'goal.csv'))
    cli.main(['plan', str(old), '--from', start, '--to', goal, '--actions', '1'], new_toy)
    assert 'another version of the engine' in capsys.readouterr().err
    cli.main(one_worker(['check', str(path), str(session)]), new_toy)
    assert 'another version' not in capsys.readouterr().err


def test_stamps_say_when_it_was_measured_if_they_can():
    assert Passport.new('', 1_700_000_000.0).measured == '2023-11-14'
    assert Passport.new('', 60.0).measured == ''
    assert UNKNOWN.words == UNKNOWN.warning == ''


def test_a_damaged_passport_is_refused(fitted):
    octets = fitted[1].read_bytes()
    assert b'<passport' in octets
    with pytest.raises(InputError):
        read_description(octets.replace(b' sha256=', b' md5='))
    without = octets[:octets.index(b'<passport')] + octets[octets.index(b'</passport>') + 11:]
    assert read_description(without).passport == UNKNOWN
