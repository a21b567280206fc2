# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `experiment`: what it writes and prints, and that it goes on where it was killed."""

import csv
import errno
import functools
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time

from PIL import Image
from processes import children
import pytest
from toy_calibrator import make_toy
from toy_messages import session_messages, TRUTH, write_session

from dlo_calibration.cli import main as cli
from dlo_calibration.files.session import samples
from dlo_calibration.messages.codec import bag_types

PATIENCE = 60.0
SMALL = ('--runs', 2, '--search', 'random', '--evaluations', 6)
FILES = {'calibrations.jsonl', 'calibrations.csv', 'consistency.csv', 'validity.csv', 'experiment.json',
         'experiment.md', 'parameters.png', 'rope_random.png', 'rope_least_squares.png'}


@pytest.fixture
def session(tmp_path):
    """Give a session of three trials, whose recorded search an experiment does not take."""
    return write_session(tmp_path / 'rope.mcap', session_messages(bag_types(), 3),
                         {'evaluations': 3, 'seed': 9, 'mass': 0.1})


@pytest.fixture
def run(capsys):
    """Give a function that returns exit code, stdout and stderr of the verb with the toy, in one process."""
    def run(*words, workers=1):
        try:
            code = cli.main(['experiment', *map(str, words), '--workers', str(workers)],
                            functools.partial(make_toy, 0.0))
        except SystemExit as end:  # argparse
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def undrawn(monkeypatch):
    """Leave pictures empty, which take longer than all the rest."""
    monkeypatch.setattr('dlo_calibration.experiment.conduct.session_picture',
                        lambda trials, chains, path: path.touch())
    monkeypatch.setattr('dlo_calibration.experiment.tables.scatter_picture', lambda *_: None)


def timeless(text):
    """Return a JSON document without how long anything lasted."""
    printed = json.loads(text)
    for finding in printed['findings']:
        finding.pop('seconds')
    return printed


@pytest.mark.long
def test_all_files_are_written_and_the_tables_printed(run, session, tmp_path):
    code, output, errors = run(session, '--runs', 2, '--search', 'random', 'least_squares',
                               '--evaluations', 12, '--output', tmp_path / 'out')
    assert code == 0
    assert {file.name for file in (tmp_path / 'out').iterdir()} == FILES
    assert output == (tmp_path / 'out' / 'experiment.md').read_text()
    assert f'are in {tmp_path / "out"}' in errors
    command = re.search('`(dlo-calibration experiment .*)`', output)[1]
    for word in (str(session), '--runs 2', 'random,least_squares', '--evaluations 12'):
        assert word in command
    with (tmp_path / 'out' / 'calibrations.csv').open(newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 2 * 2 * 4
    assert {row['seed'] for row in rows} == {'1', '2'}  # not the recorded one
    assert {row['evaluations'] for row in rows if row['search'] == 'random'} == {'12'}
    for name in FILES:
        if name.endswith('.png'):
            assert min(Image.open(tmp_path / 'out' / name).size) > 300


@pytest.mark.long
def test_the_json_document_is_the_file_and_has_the_recovered_truth(run, session, tmp_path, undrawn):
    code, output, _ = run(session, '--runs', 2, '--search', 'least_squares', '--json',
                          '--output', tmp_path / 'out')
    printed = json.loads(output)
    assert code == 0
    assert printed == json.loads((tmp_path / 'out' / 'experiment.json').read_text())
    assert printed['complete']
    assert printed['evaluations'] == {'least_squares': 150 + 100 + 400}
    finding, = printed['findings']
    means = {name: spread['mean'] for name, spread in finding['parameters'].items()}
    assert means == pytest.approx(TRUTH, abs=0.5)
    assert finding['score']['mean'] < 1
    assert finding['very_similar'] == 2
    assert set(finding['actions']) == {'trial 1', 'trial 2', 'trial 3'}


@pytest.mark.long
def test_the_numbers_are_the_same_for_any_number_of_processes(run, session, tmp_path, undrawn):
    serial = run(session, *SMALL, '--json', '--output', tmp_path / 'one')[1]
    parallel = run(session, *SMALL, '--json', '--output', tmp_path / 'two', workers=2)[1]
    first, second = timeless(serial), timeless(parallel)
    assert first.pop('command') != second.pop('command')  # it names the processes
    assert first == second


@pytest.mark.long
def test_finished_calibrations_are_not_repeated_and_more_runs_are_added(run, session, tmp_path, undrawn):
    out, journal = tmp_path / 'out', tmp_path / 'out' / 'calibrations.jsonl'
    run(session, *SMALL, '--output', out)
    before = journal.read_bytes()
    code, _, errors = run(session, *SMALL, '--output', out)
    assert (code, journal.read_bytes()) == (0, before)
    assert 'done already' not in errors  # there is nothing to do at all
    _, _, errors = run(session, '--runs', 3, *SMALL[2:], '--output', out)
    assert '8 of 12 calibrations are done already' in errors
    assert journal.read_bytes().startswith(before)
    assert len(journal.read_bytes().splitlines()) == 12


@pytest.mark.long
def test_another_session_or_option_in_the_same_folder_is_not_mixed_up(run, session, tmp_path, undrawn):
    other = write_session(tmp_path / 'other' / 'rope.mcap', session_messages(bag_types(), 3, first=2),
                          {'mass': 0.1})
    out, fresh = tmp_path / 'out', tmp_path / 'fresh'
    once = ('--runs', 1, *SMALL[2:])
    run(session, *once, '--output', out)
    for words in ((other, *once), (session, *once, '--mass', 0.2), (session, *once, '--seed', 5)):
        mixed = timeless(run(*words, '--json', '--output', out)[1])
        assert mixed == timeless(run(*words, '--json', '--output', fresh)[1])
        for file in fresh.iterdir():
            file.unlink()


def test_chosen_trials_are_held_back(run, session, tmp_path, undrawn):
    printed = json.loads(run(session, *SMALL, '--held-back', 2, '--json', '--output', tmp_path / 'out')[1])
    assert [list(finding['actions']) for finding in printed['findings']] == [['trial 2']]
    assert '--held-back 2' in printed['command']


@pytest.mark.long
def test_parameters_are_validated_on_another_session(run, session, tmp_path, undrawn):
    other = write_session(tmp_path / 'other.mcap', session_messages(bag_types(), 2, first=3), {'seed': 3})
    code, output, _ = run(session, '--runs', 2, '--search', 'least_squares', '--validate-on', other, '--json',
                          '--output', tmp_path / 'out')
    finding, = json.loads(output)['findings']
    assert code == 0
    assert list(finding['actions']) == ['trial 1', 'trial 2']  # of the other session
    assert finding['score']['mean'] < 1
    assert len((tmp_path / 'out' / 'calibrations.jsonl').read_text().splitlines()) == 2


@pytest.mark.long
def test_sessions_of_one_name_are_distinguished(run, session, tmp_path, undrawn):
    other = write_session(tmp_path / 'other' / 'rope.mcap', session_messages(bag_types(), 3, first=2))
    printed = json.loads(run(session, other, '--runs', 1, '--search', 'random', '--evaluations', 4, '--json',
                           '--output', tmp_path / 'out')[1])
    assert [finding['subject'] for finding in printed['findings']] == ['rope', 'rope_2']
    assert (tmp_path / 'out' / 'rope_2_random.png').exists()


def test_the_samples_are_the_default():
    assert sorted(path.name for path in samples().glob('object*')) == [f'object{k}' for k in range(1, 6)]


PROGRAM = """
import functools
import sys
from toy_calibrator import make_toy
from dlo_calibration.cli import main as cli
from dlo_calibration.experiment import conduct, tables

conduct.session_picture = tables.scatter_picture = lambda *_: None
if __name__ == '__main__':
    sys.exit(cli.main(sys.argv[2:], functools.partial(make_toy, float(sys.argv[1]))))
"""


def started(session, out, workers):
    """Start the verb in a process of its own; return it when it has written down something."""
    process = subprocess.Popen(
        [sys.executable, '-c', PROGRAM, '0.01', 'experiment', str(session), *map(str, SMALL), '--json',
         '--workers', str(workers), '--output', str(out)],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    begun = time.monotonic()
    file = out / 'calibrations.jsonl'
    while not file.exists() or b'\n' not in file.read_bytes():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() - begun < PATIENCE
        time.sleep(0.01)
    return process


@pytest.mark.long
def test_a_killed_experiment_goes_on_where_it_was(run, session, tmp_path, undrawn):
    out = tmp_path / 'out'
    process = started(session, out, 2)
    begun = children(process.pid)
    process.kill()
    process.communicate()
    before = (out / 'calibrations.jsonl').read_bytes()
    assert len(before.splitlines()) < 8
    assert 'experiment.md' not in {file.name for file in out.iterdir()}
    code, output, errors = run(session, *SMALL, '--json', '--output', out)
    assert code == 0
    assert re.search(r'^\d+ of 8 calibrations are done already$', errors, re.MULTILINE)
    assert (out / 'calibrations.jsonl').read_bytes().startswith(before)
    assert timeless(output) == timeless(run(session, *SMALL, '--json', '--output', tmp_path / 'whole')[1])
    ends = time.monotonic() + PATIENCE
    while any(os.path.exists(f'/proc/{pid}') for pid in begun):
        assert time.monotonic() < ends
        time.sleep(0.02)


@pytest.mark.long
def test_files_that_cannot_be_written_are_named_and_the_tables_are_printed(run, session, tmp_path, undrawn,
                                                                 monkeypatch):
    monkeypatch.chdir(tmp_path)  # a long path would shorten the sentence
    out, replace, fsync = Path('out'), os.replace, os.fsync

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, 'replace',
                      lambda new, path: full() if path.suffix == '.csv' else replace(new, path))
        code, output, errors = run(session, *SMALL, '--output', out)
    assert (code, output) == (2, (out / 'experiment.md').read_text())
    assert ('could not be written: consistency.csv, validity.csv, calibrations.csv: No space left on device; '
            'experiment.md, experiment.json') in errors.splitlines()[-1]
    assert not {'validity.csv', 'consistency.csv', 'calibrations.csv'} & {file.name for file in out.iterdir()}
    # A disk on which the journal finds no room after the first run: what is done is told, and kept as far
    # as there was room.
    synced = []
    with monkeypatch.context() as patch:
        patch.setattr(
            os, 'fsync', lambda file: full() if len(synced) == 4 else synced.append(file) or fsync(file))
        code, output, errors = run(session, *SMALL, '--output', tmp_path / 'other')
    assert code == 2
    assert 'Not complete' in output
    assert 'could not be written: the end of calibrations.jsonl, ' in errors.splitlines()[-1]
    code, _, errors = run(session, *SMALL, '--output', tmp_path / 'other')
    assert code == 0
    assert re.search('^[45] of 8 calibrations are done already$', errors, re.MULTILINE)


@pytest.mark.parametrize('make', [os.mkfifo, lambda path: path.symlink_to(path.parent / 'elsewhere')])
def test_a_journal_that_is_no_file_is_refused_at_once(run, session, tmp_path, make):
    (tmp_path / 'out').mkdir()
    make(tmp_path / 'out' / 'calibrations.jsonl')
    code, output, errors = run(session, *SMALL, '--output', tmp_path / 'out')
    assert (code, output) == (2, '')
    assert 'calibrations.jsonl' in errors.splitlines()[-1]
    assert [file.name for file in (tmp_path / 'out').iterdir()] == ['calibrations.jsonl']


@pytest.mark.parametrize(('workers', 'number'), [
    pytest.param(1, signal.SIGINT, marks=pytest.mark.long),
    pytest.param(2, signal.SIGTERM, marks=pytest.mark.long)])
def test_an_interrupt_keeps_finished_calibrations(session, tmp_path, workers, number):
    process = started(session, tmp_path / 'out', workers)
    process.send_signal(number)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + number, errors
    assert 'Traceback' not in errors
    assert 'interrupted' in errors
    done = (tmp_path / 'out' / 'calibrations.jsonl').read_text().splitlines()
    assert 1 <= len(done) < 8
    assert all(json.loads(line)['outcome']['values'] for line in done)


@pytest.mark.parametrize(('words', 'said'), [
    (('nowhere',), 'nowhere'),
    (('{session}', '--runs', '0'), '--runs: 0'),
    (('{session}', '--search', 'guess'), "parameter search: 'guess'"),
    (('{session}', '--search', ','), '--search: no name'),
    (('{session}', '--held-back', '4'), '--held-back: 4; expected 1 to 3'),
    (('{session}', '--held-back', 'x'), '--held-back'),
    (('{session}', '--held-back', '1', '--validate-on', '{session}'), 'not allowed with'),
    (('{session}', '--validate-on', '{session}', '{session}'), '--validate-on: 2 session(s)'),
    (('{session}', '--mass', '-1'), 'parameter mass'),
    (('{session}', '--output', '{session}'), 'choose another place'),
    (('{session}', '--pictures'), '--pictures'),
], ids=lambda words: words if isinstance(words, str) else None)
def test_unusable_input_ends_with_one_line(run, session, words, said):
    code, output, errors = run(*(word.format(session=session) for word in words))
    assert (code, output) == (2, '')
    assert said in errors.splitlines()[-1]
    assert len(errors.splitlines()) == 1


def test_a_session_of_one_trial_cannot_be_cross_validated(run, tmp_path, undrawn):
    short = write_session(tmp_path / 'short.mcap', session_messages(bag_types(), 1))
    code, _, errors = run(short, '--output', tmp_path / 'out')
    assert code == 2
    assert '--validate-on' in errors
    other = write_session(tmp_path / 'other.mcap', session_messages(bag_types(), 1, first=1))
    assert run(short, '--validate-on', other, '--runs', 1, '--evaluations', 3, '--search', 'random',
               '--output', tmp_path / 'out')[0] == 0


def test_the_table_says_which_calibrations_failed(session, tmp_path, capsys):
    from toy_simulator import ToySimulator
    code = cli.main(['experiment', str(session), '--runs', '1', '--search', 'random', '--evaluations', '3',
                     '--workers', '1', '--output', str(tmp_path / 'out')],
                    lambda options: ToySimulator(fail_below=101.0))
    assert code == 0
    assert '| 4 |' in capsys.readouterr().out
