# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The command line ends at a signal with one line, whatever it is doing, and leaves nothing unfinished."""

import os
import signal
import subprocess
import sys
import time

import pytest

from dlo_calibration.files.session import samples

PATIENCE = 60.0  # s

#: The command line, in which something else takes the place of the verbs.
PROGRAM = """
import sqlite3, sys, time, types
from pathlib import Path
from dlo_calibration import __main__ as program
sys.modules['dlo_calibration.cli.main'] = verbs = types.ModuleType('verbs')
def write():
    from dlo_calibration.writing import whole
    with whole(Path(sys.argv[1]) / 'result.xml') as new:
        new.write_text('half of it')
        time.sleep(600)
def load():
    class Library:
        def __del__(self):
            (Path(sys.argv[1]) / '.begun').touch()
            time.sleep(600)  # an exception here would be shown, and ignored
    Library()
def compute():
    (Path(sys.argv[1]) / '.begun').touch()  # one call of C for half an hour
    sqlite3.connect(':memory:').execute("SELECT instr(zeroblob(20000000), zeroblob(10000000) || x'01')")
verbs.main = {'write': write, 'load': load, 'compute': compute}[sys.argv[2]]
sys.exit(program.main())
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('work', ['write', 'load', 'compute'])
def test_a_signal_ends_it_with_one_line_and_no_unfinished_file(tmp_path, number, work):
    process = subprocess.Popen([sys.executable, '-c', PROGRAM, tmp_path, work], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True,
                               env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    try:
        begun = time.monotonic()
        while not list(tmp_path.iterdir()):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() - begun < PATIENCE
            time.sleep(0.01)
        process.send_signal(number)
        output, errors = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert (process.returncode, output, errors) == (128 + number, '', 'dlo-calibration: interrupted\n')
    assert [path.name for path in tmp_path.iterdir()] == ([] if work == 'write' else ['.begun'])


SECOND = """
import os, signal
from dlo_calibration.signals import end_at_signals
write = os.write
def written(number, octets):
    write(number, octets)
    os.write = write
    os.kill(os.getpid(), signal.SIGTERM)
os.write = written
end_at_signals('dlo-calibration')
os.kill(os.getpid(), signal.SIGINT)
signal.pause()
"""


def test_a_second_signal_while_the_first_one_ends_it_adds_no_line():
    done = subprocess.run([sys.executable, '-c', SECOND], capture_output=True, text=True, timeout=PATIENCE,
                          env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    assert (done.returncode, done.stderr) == (128 + signal.SIGINT, 'dlo-calibration: interrupted\n')


@pytest.mark.parametrize('words', [('--json',), pytest.param((), marks=pytest.mark.long)])
def test_a_full_standard_output_gives_one_line(words):
    with open('/dev/full', 'w') as full:
        done = subprocess.run(
            [sys.executable, '-m', 'dlo_calibration', 'info', samples() / 'object1', *words],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=PATIENCE)
    assert done.returncode == 2
    assert done.stderr == ('dlo-calibration: standard output: could not be written: No space left on device; '
                           'make room, and repeat the command\n')
