# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Definitions of a DLO: exact there and back, and nothing read that should not be."""

from dataclasses import asdict, replace
import re

from fitted import fitted
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree
import numpy as np
import pytest
from random_examples import drawing
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.files.result import (
    Description,
    description_document,
    read_description,
    read_result,
    write_result,
)
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.search.protocol import Hints
from dlo_calibration.search.sampling import RandomSearch

OPTIONS = Options.of({'mass': 0.1 + 0.2, 'calibrate': ['friction', 'flexibility'], 'damping': 1 / 3})
TRUTH = {'flexibility': 41.0, 'elasticity': 30.0, 'friction': 62.0, 'self_collision': 20.0}


def calibrated(seed=1, mass=0.1 + 0.2):
    space = ParameterSpace(('friction', 'flexibility'), {'elasticity': 100 / 3, 'damping': 1 / 3}, mass)
    trials = [toy_trial(TRUTH), toy_trial(TRUTH, 'trial 2', turn=0.3)]
    search = RandomSearch(2, seed, Hints.none(2, space.upper))
    return fitted(trials, space, ToySimulator(), search, budget=20, seed=seed)


@pytest.fixture(scope='module')
def result():
    return calibrated()


@pytest.fixture
def file(tmp_path, result):
    """Give the path of a result file that can be read."""
    write_result(tmp_path / 'result.xml', result, OPTIONS.flat())
    return tmp_path / 'result.xml'


def refused(path, match):
    with pytest.raises(InputError, match=match) as caught:
        read_result(path)
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('mass', [0.0, 0.1 + 0.2])
def test_same_physical_values_bit_for_bit(tmp_path, seed, mass):
    result = calibrated(seed, mass)
    write_result(tmp_path / 'result.xml', result)
    description = read_result(tmp_path / 'result.xml')
    assert description.values == result.values
    assert description.physical() == result.physical()
    assert (description.space.free, description.space.mass) == (result.space.free, result.space.mass)


def test_value_of_a_found_parameter_in_the_options_does_not_count(tmp_path):
    space = Options.of({'calibrate': ['friction'], 'friction': 12.0, 'damping': 80.0}).space
    result = fitted([toy_trial(TRUTH)], space, ToySimulator(), RandomSearch(1, 1), budget=3)
    write_result(tmp_path / 'result.xml', result)
    description = read_result(tmp_path / 'result.xml')
    assert description.physical() == result.physical()
    assert 'friction' not in description.fixed and description.fixed['damping'] == 80.0


def test_same_simulation_bit_for_bit(file, result):
    description = read_result(file)
    for goals, trial in zip(result.chains, result.trials, strict=True):
        rollout = ToySimulator().simulate(trial, description.physical())
        np.testing.assert_allclose(rollout.chains, goals, atol=1e-12)
        first = ToySimulator().simulate(trial, result.physical())
        np.testing.assert_array_equal(rollout.chains, first.chains)


def test_everything_else_comes_back(file, result):
    description = read_result(file)
    assert {name: asdict(p) for name, p in description.parameters.items()} == {
        name: asdict(p) for name, p in result.parameters.items()}
    assert list(description.parameters) == ['friction', 'flexibility']
    assert (description.score, description.scores) == (result.best.score, result.best.scores)
    assert description.errors == result.errors
    assert (description.search, description.engine, description.seed) == ('random', 'toy', 1)
    assert (description.evaluations, description.simulations) == (20, result.simulations)
    assert (description.stop_reason, description.seconds) == (result.stop_reason, result.seconds)
    assert (description.trials, description.warnings) == (('trial 1', 'trial 2'), result.warnings)
    np.testing.assert_array_equal(description.chain.points, result.trials[0].initial.points)
    assert description.chain.hands is None and not description.chain.features.any()
    assert description.file_options.options() == OPTIONS


def test_writing_what_was_read_gives_the_same_bytes(file):
    assert description_document(read_result(file)) == file.read_bytes()


def test_a_document_from_before_there_were_verdicts_stays_as_it_is(file):
    older = re.sub(rb' (verdict|note)="[^"]*"', b'', file.read_bytes())
    assert older != file.read_bytes()
    file.write_bytes(older)
    assert description_document(read_result(file)) == older


def test_correlations_come_back(file, result):
    description = read_result(file).correlations
    assert description == result.correlations
    assert description['friction']['flexibility'] == description['flexibility']['friction'] != 0
    assert description['friction']['friction'] == 1


def test_a_document_from_before_there_were_correlations_stays_as_it_is(file):
    older = re.sub(rb' *<correlations>.*</correlations>\n', b'', file.read_bytes(), flags=re.DOTALL)
    assert older != file.read_bytes()
    file.write_bytes(older)
    assert read_result(file).correlations is None
    assert description_document(read_result(file)) == older


def test_a_missing_pair_is_refused(file):
    text = re.sub('<correlation .*/>', '', file.read_text(encoding='utf-8'))
    file.write_text(text, encoding='utf-8')
    refused(file, '<correlations>.*0 correlations; expected 1, one for each pair')


def test_document_is_for_people_too(file):
    lines = file.read_text(encoding='utf-8').splitlines()
    assert lines[0] == "<?xml version='1.0' encoding='UTF-8'?>"
    assert any(re.fullmatch(r' +<found name="flexibility" value="[0-9.]+".*/>', line) for line in lines)


def test_a_result_that_should_not_be_used_says_so_wherever_it_is_read(tmp_path, result):
    doubted = replace(result, implausible=('trial 1: a DLO on the Moon',))
    write_result(tmp_path / 'doubted.xml', doubted, OPTIONS.flat())
    description = read_result(tmp_path / 'doubted.xml')
    assert description.unusable == doubted.unusable == doubted.implausible[0]
    assert description.file_options.warnings == (f'do not use this result: {doubted.implausible[0]}',)
    sound = Description.of(replace(result, choice=None))
    assert sound.unusable == ''
    assert read_description(description_document(sound)).file_options.warnings == ()


@drawing(20)
@given(text=st.text(max_size=30), value=st.floats(0, 100), length=st.floats(1e-6, 1e6))
def test_any_text_and_number_survives(tmp_path_factory, result, text, value, length):
    path = tmp_path_factory.mktemp('any') / 'result.xml'
    flexibility = replace(result.parameters['flexibility'], value=value, physical_unit=text)
    given_file = replace(Description.of(result), parameters={'flexibility': flexibility}, length=length,
                         stop_reason=text, warnings=(text,))
    write_result(path, given_file)
    description = read_result(path)
    assert (description.values, description.length) == ({'flexibility': value}, length)
    printable = ''.join(c if c in '\t\n\r' or ' ' <= c < '\ufffe' or c > '\uffff' else '\ufffd' for c in text)
    printable = re.sub('[\ud800-\udfff]', '\ufffd', printable)
    assert description.stop_reason == description.parameters['flexibility'].physical_unit == printable
    assert description.warnings == (printable,)


@pytest.mark.parametrize('change, match', [
    (('version="2"', 'version="3"'), "<dlo>.*version.*'3'.*expected one of '1', '2'"),
    (('<dlo version="2"', '<dlo version="2" more="1"'), "<dlo>.*'more'"),
    (('<calibration ', '<calibration colour="red" '), '<calibration>.*colour'),
    (('<fixed name="elasticity" value="', '<fixed name="elasticity" value="9'), '<fixed>.*value.*0 to 100'),
    (('<fixed name="elasticity" value="3', '<fixed name="elasticity" value="4'), '<fixed>.*; change both'),
    (('physical_unit="s"/>', 'physical_unit="ms"/>'), '<fixed>.*ms.*expected.* s'),
    (('<found name="friction" value="', '<found name="friction" value="1e9'), '<found>.*value'),
    (('<found name="friction" value="', '<found name="friction" value="x'), '<found>.*value.*a finite'),
    (('<found name="friction"', '<found'), '<found>.*name'),
    (('score="', 'score="nan'), 'score'),
    (('score="', 'score="1e999" x="'), '<fit>.*x'),
    (('<point x="0.0"', '<point x="inf"'), '<point>.*x'),
    (('<point x="0.0"', '<point x="1e999"'), '<point>.*x.*1e999'),
    (('<point x="0.0"', '<point hand="256" x="0.0"'), '<point>.*hand.*256'),
    (('seed="1"', 'seed="1.5"'), '<calibration>.*seed'),
    (('mass="', 'mass="-'), 'mass'),
    (('identifiable="', 'identifiable="per'), 'identifiable'),
    (('<correlation first="friction"', '<correlation first="flexibility"'), '<correlation>.*two found'),
    (('<correlation first="friction"', '<correlation first="damping"'), "<correlation>.*'damping'"),
    (('second="flexibility" value="', 'second="flexibility" value="nan'), '<correlation>.*value'),
    (('<options>', '<options>text'), '<options>'),
    (('<warnings/>', '<warnings/><warnings/>'), '<warnings>'),
    (('name="seed" value="1"', 'name="seed" value="{"'), '<option>.*seed.*an integer'),
    (('name="seed" value="1"', 'name="weed" value="1"'), '<option>.*weed'),
    (('name="table" value="true"', 'name="table" value="yes"'), '<option>.*table.*true or false'),
])
def test_unexpected_is_refused_by_line_and_element(file, change, match):
    text = file.read_text(encoding='utf-8')
    line = text[:text.index(change[0])].count('\n') + 1
    file.write_text(text.replace(*change, 1), encoding='utf-8')
    assert f', line {line}, element <' in refused(file, match)


def test_a_correlation_is_a_cosine(file):
    text = re.sub('(second="flexibility" value=")[^"]*', r'\g<1>-1.1', file.read_text(encoding='utf-8'))
    file.write_text(text, encoding='utf-8')
    refused(file, '<correlation>.*-1.1.*-1 to 1')


@pytest.mark.parametrize('change, match', [
    (('<point x="0.0"', '<point hand="1" x="0.0"'), '<point>.*hand'),
    (('<point x="0.0"', '<point x="1e9"'), '<chain>.*1e.09 m in point 0'),
    (('<fit ', '<hunt '), 'no XML document|<hunt>'),
    (('<fixed name="damping"', '<fixed name="friction"'), '<fixed>.*friction.*twice'),
    (('<fixed name="damping"', '<fixed name="weight"'), 'weight'),
    (('<fixed name="damping"', '<fixed name="elasticity"'), '<fixed>.*elasticity.*twice'),
    (('<found name="friction"', '<found name="flexibility"'), '<found>.*flexibility.*twice'),
    (('<correlations>', '<correlations><correlation first="flexibility" second="friction" value="0"/>'),
     '<correlation>.*twice'),
    (('</correlations>', '</correlations><correlations/>'), '<correlations>'),
    (('<warnings/>', ''), '<calibration>.*Missing.*warnings'),
    (('name="seed" value="1"', 'name="evaluations" value="1"'), '<option>.*evaluations.*twice'),
])
def test_contradicting_elements_are_refused(file, change, match):
    text = file.read_text(encoding='utf-8')
    assert change[0] in text
    file.write_text(text.replace(*change, 1), encoding='utf-8')
    assert ', line ' in refused(file, match)


@pytest.mark.parametrize('path, attribute', [
    ('parameters/found', 'value'), ('.', 'length'), ('calibration', 'search'), ('chain/point', 'x')])
def test_missing_attribute_is_named(file, path, attribute):
    tree = etree.parse(str(file))
    element = tree.find(path)
    del element.attrib[attribute]
    line = element.sourceline
    tree.write(str(file), xml_declaration=True, encoding='UTF-8')
    refused(file, f"line {line}, element <{element.tag}>.*'{attribute}'")


def test_hand_written_description_keeps_its_annotations(result):
    hands = np.zeros(11, np.uint8)
    hands[[0, 1]] = 2
    chain = Chain(result.trials[0].initial.points, hands, np.arange(11) == 4)
    description = read_description(description_document(replace(Description.of(result), chain=chain)))
    np.testing.assert_array_equal(description.chain.hands, hands)
    np.testing.assert_array_equal(np.flatnonzero(description.chain.features), [4])


def test_text_of_a_message_is_read_too(result):
    octets = description_document(result)
    assert read_description(octets.decode()).values == result.values
    with pytest.raises(InputError, match='dlo_description, line 1'):
        read_description('no document')


def test_fixed_values_are_complete_and_in_units(result):
    description = read_description(description_document(result))
    names = {parameter.name for parameter in ParameterSpace().parameters}
    assert set(description.fixed) | set(description.values) == names - {'mass'}
    element = etree.fromstring(description_document(result)).find('.//fixed[@name="elasticity"]')
    assert element.get('physical_unit') == 'N'
    assert float(element.get('physical_value')) == pytest.approx(result.physical()['elasticity'])


def test_path_without_file_is_refused(tmp_path):
    refused(tmp_path / 'missing.xml', 'missing.xml')
    refused(tmp_path, 'result file')


def test_place_that_cannot_be_written_is_refused(tmp_path, result):
    with pytest.raises(InputError, match='result.xml'):
        write_result(tmp_path / 'missing' / 'result.xml', result)


@drawing(20)
@given(place=st.floats(0, 1), octets=st.binary(max_size=6))
def test_damaged_anywhere_is_read_or_refused(tmp_path_factory, result, place, octets):
    document = bytearray(description_document(result, OPTIONS.flat()))
    at = int(place * len(document))
    document[at:at + len(octets)] = octets
    path = tmp_path_factory.mktemp('damaged') / 'result.xml'
    path.write_bytes(document)
    try:
        read_result(path)
    except InputError as error:
        assert str(path) in str(error)


def of_first_scale(text):
    """Return a document as version 1 wrote it, when flexibility 0 was 0.1 N m^2: 30 was 51.538..."""
    def old(match):
        value = (float(match[2]) - (0 if match[1] == 'std' else 400 / 13)) * 13 / 9
        return f'{match[1]}="{value!r}"'

    def element(match):
        return re.sub(r'\b(value|std|lower|upper)="([^"]*)"', old, match[0])

    return re.sub(r'<\w+ name="flexibility"[^>]*>', element,
                  text.replace('<dlo version="2"', '<dlo version="1"'))


def test_a_result_of_the_first_scale_has_the_same_physical_values(file):
    today = read_result(file)
    file.write_text(of_first_scale(file.read_text(encoding='utf-8')), encoding='utf-8')
    assert f'value="{today.values["flexibility"]}"' not in file.read_text(encoding='utf-8')
    description = read_result(file)
    assert description.physical() == pytest.approx(today.physical())
    now, then = today.parameters['flexibility'], description.parameters['flexibility']
    for name in ('value', 'std', 'lower', 'upper'):
        assert getattr(then, name) == pytest.approx(getattr(now, name))
    assert description.file_options.values['flexibility'] == pytest.approx(OPTIONS.flat()['flexibility'])


def test_an_interval_that_the_first_scale_cut_is_still_open(file):
    text = re.sub('(<found name="flexibility".* lower=)"[^"]*"', r'\1"0.0"',
                  file.read_text(encoding='utf-8').replace('<dlo version="2"', '<dlo version="1"'))
    file.write_text(text, encoding='utf-8')
    assert read_result(file).parameters['flexibility'].lower == 0.0
