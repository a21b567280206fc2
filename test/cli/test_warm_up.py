# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `warm-up`: what it says, and that a second time it has nothing to do."""

from importlib import import_module
from pathlib import Path

from dlo_calibration.calibration.options import Options

told = import_module('dlo_calibration.cli.told')


def test_a_second_time_it_is_all_there(command):
    for _ in range(2):
        code, found, _ = command('warm-up', '--json')
        assert code == 0
        assert [one['name'] for one in found['compiled']] == [
            'simulation', 'simulation of several trials at once', 'tracer']
        assert all(list(Path(one['folder']).glob('*.compiled')) for one in found['compiled'])
    assert not any(one['compiled'] for one in found['compiled'])


def test_a_verb_tells_that_it_compiles_before_it_does(monkeypatch, capsys):
    done = []
    monkeypatch.setattr(told, 'is_compiled', lambda module: module in dict(done))
    monkeypatch.setattr(told, 'compile_kernels',
                        lambda module: done.append((module, capsys.readouterr().err)))
    for _ in range(2):
        told.make_told(Options()).close()
    assert [text for _, text in done] == [
        f'compiling the {what} for this machine, once, about half a minute\n'
        for what in ('simulation', 'simulation of several trials at once')]
