# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A misspelt name is answered with the one that was probably meant, wherever names are read."""

import argparse
from pathlib import Path

import pytest

from dlo_calibration.calibration.options import Options
from dlo_calibration.capture.json_values import JsonValue
from dlo_calibration.cli import main as cli
from dlo_calibration.errors import InputError
from dlo_calibration.files.request import request_of
from dlo_calibration.model.named_actions import TwoHands
from dlo_calibration.model.parameters import ParameterSpace

SAMPLES = Path(__file__).resolve().parents[2] / 'msg_samples'
OBJECT = str(SAMPLES / 'object1')


@pytest.mark.parametrize('words, meant', [
    ('ft', 'fit'), ('valdate', 'validate'), ('fit x --evalations 5', '--evaluations'),
    ('fit x --bending_frction 5', '--bending-friction'),
    (f'fit {OBJECT} --search least-square', 'least_squares'), (f'fit {OBJECT} --engine Bulet', 'bullet'),
    (f'fit {OBJECT} --calibrate flexibilty friction', 'flexibility'),
    ('experiment --search lest_squares', 'least_squares')])
def test_a_misspelt_word_of_the_command_line_gets_a_suggestion(words, meant, capsys):
    try:
        code = cli.main(words.split())
    except SystemExit as end:
        code = end.code
    output, errors = capsys.readouterr()
    assert (code, output, errors.count('\n')) == (2, '', 1)
    assert f'did you mean {meant}?' in errors


def test_a_name_that_resembles_none_gets_no_suggestion(capsys):
    assert cli.main(['zzz']) == 2
    assert 'did you mean' not in capsys.readouterr().err


@pytest.mark.parametrize('wrong, right, meant', [
    ('<grasp_and_plase', '<grasp_and_place', 'grasp_and_place'), (' sped=', ' speed=', 'speed'),
    ('"togeter"', '"together"', 'together'), ('"evalutions"', '"evaluations"', 'evaluations'),
    ('name="search" value="randon"', 'name="seed" value="1"', 'random')])
def test_a_misspelt_name_in_a_document_gets_a_suggestion(wrong, right, meant):
    text = (SAMPLES / 'xml' / 'named_actions.xml').read_text(encoding='utf-8')
    assert right in text
    with pytest.raises(InputError, match=rf'did you mean {meant}\?'):
        request_of(text.replace(right, wrong).encode())


def test_a_known_name_in_the_wrong_place_gets_no_suggestion():
    text = (SAMPLES / 'xml' / 'named_actions.xml').read_text(encoding='utf-8')
    with pytest.raises(InputError) as refused:
        request_of(text.replace('<initial_chain', '<goal_chain', 1).replace(
            '</initial_chain', '</goal_chain', 1).encode())
    assert 'did you mean' not in str(refused.value)


@pytest.mark.parametrize('make, meant', [
    (lambda: Options.of({'sead': 2}), 'seed'), (lambda: Options(search='cmaes'), 'cma_es'),
    (lambda: ParameterSpace(('frction',)), 'friction'),
    (lambda: TwoHands(fractions=(0.1, 0.9), motion='togther'), 'together'),
    (lambda: JsonValue('', {'photografs': []}).only('photographs', 'trials'), 'photographs')],
    ids=['option', 'search', 'parameter', 'named action', 'JSON'])
def test_a_misspelt_name_in_the_library_gets_a_suggestion(make, meant):
    with pytest.raises(InputError, match=rf'did you mean {meant}\?'):
        make()


@pytest.mark.parametrize('verb', ['fit', 'validate', 'simulate', 'plan', 'plot', 'experiment', 'export',
                                  'capture'])
def test_each_parameter_of_the_node_is_a_flag_of_each_verb_that_simulates(verb):
    parser = argparse.ArgumentParser()
    cli.module_of(verb).add_arguments(parser)
    assert {f'--{name.replace("_", "-")}' for name in Options().flat()} <= {*parser._option_string_actions}


def test_simulate_takes_workers_and_says_which_flags_change_nothing(tmp_path, capsys):
    words = ['simulate', str(SAMPLES / 'xml/dlo.xml'), str(SAMPLES / 'xml/hand_paths.xml'), '--draws', '0']
    assert cli.main([*words, '--workers', '1', '--mass', '0.3']) == 0
    errors = capsys.readouterr().err
    assert '--mass: has no effect on simulate' in errors and '--workers' not in errors
