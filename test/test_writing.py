# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Files are whole or not there at all."""

import errno
import os
from pathlib import Path
import resource
import signal
import stat
import subprocess
import sys

import pytest

from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.writing import Attempts, make_folder, remove_unfinished, scratch_folder, whole

FULL = os.strerror(errno.ENOSPC)


def test_a_file_appears_when_it_is_whole_and_has_the_usual_permissions(tmp_path):
    path, usual = tmp_path / 'one.txt', tmp_path / 'usual'
    usual.write_text('')
    with whole(path) as new:
        new.write_text('half')
        assert not path.exists()
        with new.open('a') as stream:
            stream.write(' and half')
    assert path.read_text() == 'half and half'
    assert path.stat().st_mode == usual.stat().st_mode
    assert sorted(tmp_path.iterdir()) == [path, usual]


@pytest.mark.parametrize('error', [KeyboardInterrupt, OSError(errno.EIO, 'broken'), ValueError])
def test_whatever_happens_meanwhile_the_old_file_stays_and_nothing_else(tmp_path, error):
    path = tmp_path / 'one.txt'
    path.write_text('old')
    with pytest.raises(InputError if isinstance(error, OSError) else error):
        with whole(path) as new:
            new.write_text('ne')
            raise error
    assert path.read_text() == 'old'
    assert list(tmp_path.iterdir()) == [path]


def test_a_process_that_ends_meanwhile_removes_what_is_unfinished(tmp_path):
    with pytest.raises(InputError):  # as it is gone
        with whole(tmp_path / 'one.txt') as new:
            new.write_text('ne')
            remove_unfinished()
            assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('there', [True, False])
def test_a_link_is_replaced_and_not_followed(tmp_path, there):
    path, other = tmp_path / 'one.txt', tmp_path / 'other.txt'
    if there:
        other.write_text('precious')
    path.symlink_to(other)
    with whole(path) as new:
        new.write_text('new')
    assert path.read_text() == 'new'
    assert not path.is_symlink()
    assert other.exists() == there
    assert not there or other.read_text() == 'precious'


@pytest.mark.parametrize('make', [os.mkfifo, os.mkdir])
def test_a_path_that_is_no_file_is_refused_at_once(tmp_path, make):
    make(tmp_path / 'one.txt')
    with pytest.raises(InputError, match='one.txt'):
        with whole(tmp_path / 'one.txt') as new:
            new.write_text('new')
    assert [path.name for path in tmp_path.iterdir()] == ['one.txt']
    assert not stat.S_ISREG((tmp_path / 'one.txt').stat().st_mode)


def test_a_full_disk_leaves_no_part_of_a_file(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(InputError, match='one.txt'):
            with whole(tmp_path / 'one.txt') as new:
                new.write_bytes(bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_can_be_used_is_made_and_stays_empty(tmp_path):
    make_folder(tmp_path / 'a' / 'b')
    make_folder(tmp_path / 'a' / 'b')
    assert list((tmp_path / 'a' / 'b').iterdir()) == []
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match='file'):
        make_folder(tmp_path / 'file')


def test_a_full_folder_is_refused_before_it_is_needed(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, FULL)

    monkeypatch.setattr(Path, 'write_bytes', full)
    with pytest.raises(InputError, match=FULL):
        make_folder(tmp_path / 'out')
    assert list((tmp_path / 'out').iterdir()) == []


def test_one_file_that_fails_does_not_prevent_the_next_and_is_named(tmp_path):
    attempts = Attempts(tmp_path)
    for name in ('a.txt', 'b.txt', 'c.txt'):
        with attempts.attempt(name):
            if name == 'b.txt':
                raise OSError(errno.ENOSPC, FULL)
            (tmp_path / name).write_text('')
    with pytest.raises(DloCalibrationError) as raised:
        attempts.require()
    text = str(raised.value)
    assert f'b.txt: {FULL}' in text
    assert 'a.txt, c.txt could be' in text
    assert str(tmp_path) in text


#: Unpacks a compressed recording for ever.
UNPACKING = """
import sys, time
from dlo_calibration.__main__ import main
from dlo_calibration.files import bag_reader

def unpack_file(_, target, *__):
    target.write_bytes(bytes(1000))
    print('unpacking', flush=True)
    time.sleep(60)

bag_reader.unpack_file = unpack_file
sys.exit(main())
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_command_that_ends_while_it_unpacks_leaves_no_folder_for_long(number, tmp_path, monkeypatch):
    session, temporary = tmp_path / 'session.mcap.zstd', tmp_path / 'tmp'
    session.write_bytes(b'compressed')
    temporary.mkdir()
    environment = {**os.environ, 'TMPDIR': str(temporary)}
    with subprocess.Popen([sys.executable, '-c', UNPACKING, 'info', str(session)], text=True, env=environment,
                          stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout.readline() == 'unpacking\n'
        process.send_signal(number)
    assert len(list(temporary.iterdir())) == (number == signal.SIGKILL)
    monkeypatch.setattr('tempfile.tempdir', str(temporary))
    with scratch_folder() as folder:
        assert list(temporary.iterdir()) == [folder]  # not that of the killed process
        with scratch_folder() as other:
            assert sorted(temporary.iterdir()) == sorted([folder, other])  # both are in use
    assert list(temporary.iterdir()) == []
