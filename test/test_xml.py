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


"""Result files: exact there and back, and nothing read that should not be."""

from dataclasses import asdict, replace
import re

from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import etree
import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration.calibration import calibrate, Evaluator
from dlo_calibration.config import Options
from dlo_calibration.errors import InputError
from dlo_calibration.parameters import ParameterSpace
from dlo_calibration.search.random import RandomSearch
from dlo_calibration.xml import read_result, result_document, ResultFile, write_result

OPTIONS = Options.of({'mass': 0.1 + 0.2, 'calibrate': ['friction', 'flexibility'], 'damping': 1 / 3})
TRUTH = {'flexibility': 41.0, 'elasticity': 30.0, 'friction': 62.0, 'self_collision': 20.0}


def calibrated(seed=1, mass=0.1 + 0.2):
    space = ParameterSpace(('friction', 'flexibility'), {'elasticity': 100 / 3, 'damping': 1 / 3}, mass)
    trials = [toy_trial(TRUTH), toy_trial(TRUTH, 'trial 2', turn=0.3)]
    return calibrate(trials, space, ToySimulator(), RandomSearch(2, seed), budget=20, seed=seed)


@pytest.fixture(scope='module')
def result():
    return calibrated()


@pytest.fixture
def file(tmp_path, result):
    """Give the path of a result file that can be read."""
    write_result(tmp_path / 'result.xml', result, OPTIONS.flat())
    return tmp_path / 'result.xml'


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('mass', [0.0, 0.1 + 0.2])
def test_same_physical_values_bit_for_bit(tmp_path, seed, mass):
    result = calibrated(seed, mass)
    write_result(tmp_path / 'result.xml', result)
    found = read_result(tmp_path / 'result.xml')
    assert found.values == result.values
    assert found.physical() == result.physical()
    assert found.space == result.space


def test_value_of_a_found_parameter_in_the_options_does_not_count(tmp_path):
    space = Options.of({'calibrate': ['friction'], 'friction': 12.0, 'damping': 80.0}).space
    result = calibrate([toy_trial(TRUTH)], space, ToySimulator(), RandomSearch(1, 1), budget=3)
    write_result(tmp_path / 'result.xml', result)
    found = read_result(tmp_path / 'result.xml')
    assert found.physical() == result.physical()
    assert 'friction' not in found.fixed and found.fixed['damping'] == 80.0


def test_same_simulation_bit_for_bit(file, result):
    found = read_result(file)
    rollouts = Evaluator(result.trials, found.space, ToySimulator()).simulate(found.values)
    for rollout, goals, trial in zip(rollouts, result.chains, result.trials, strict=True):
        np.testing.assert_allclose(rollout.chains, goals, atol=1e-12)
        first, = Evaluator([trial], result.space, ToySimulator()).simulate(result.values)
        np.testing.assert_array_equal(rollout.chains, first.chains)


def test_everything_else_comes_back(file, result):
    found = read_result(file)
    assert {name: asdict(p) for name, p in found.parameters.items()} == {
        name: asdict(p) for name, p in result.parameters.items()}
    assert list(found.parameters) == ['friction', 'flexibility']
    assert (found.score, found.scores, found.errors) == (result.best.score, result.best.scores, result.errors)
    assert (found.search, found.engine, found.seed) == ('random', 'toy', 1)
    assert (found.evaluations, found.simulations, found.stop_reason, found.seconds) == (
        20, 40, result.stop_reason, result.seconds)
    assert (found.trials, found.warnings) == (('trial 1', 'trial 2'), result.warnings)
    np.testing.assert_array_equal(found.points, result.trials[0].initial.points)
    assert Options.of(found.options) == OPTIONS


def test_writing_what_was_read_gives_the_same_bytes(file):
    assert result_document(read_result(file)) == file.read_bytes()


def test_document_is_for_people_too(file):
    lines = file.read_text(encoding='utf-8').splitlines()
    assert lines[0] == "<?xml version='1.0' encoding='UTF-8'?>"
    assert any(re.fullmatch(r' +<parameter name="flexibility" value="[0-9.]+".*/>', line) for line in lines)


@settings(max_examples=200, deadline=None)
@given(text=st.text(max_size=30), value=st.floats(0, 100), length=st.floats(1e-6, 1e6))
def test_any_text_and_number_survives(tmp_path_factory, result, text, value, length):
    path = tmp_path_factory.mktemp('any') / 'result.xml'
    flexibility = replace(result.parameters['flexibility'], value=value, physical_unit=text)
    given_file = replace(ResultFile.of(result), parameters={'flexibility': flexibility}, length=length,
                         stop_reason=text, warnings=(text,))
    write_result(path, given_file)
    found = read_result(path)
    assert (found.values, found.length) == ({'flexibility': value}, length)
    printable = ''.join(c if c in '\t\n\r' or ' ' <= c < '\ufffe' or c > '\uffff' else '\ufffd' for c in text)
    printable = re.sub('[\ud800-\udfff]', '\ufffd', printable)
    assert found.stop_reason == found.parameters['flexibility'].physical_unit == printable
    assert found.warnings == (printable,)


def refused(path, match):
    with pytest.raises(InputError, match=match) as caught:
        read_result(path)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('change, match', [
    (('version="1"', 'version="2"'), 'calibration_result.*version'),
    (('<calibration_result version="1">', '<calibration_result version="1" more="1">'), "'more'"),
    (('<search ', '<hunt '), '<hunt>'),
    (('<dlo ', '<dlo colour="red" '), '<dlo>.*colour'),
    (('<fixed name="damping"', '<fixed name="friction"'), '<fixed>.*friction'),
    (('<fixed name="damping"', '<fixed name="weight"'), 'weight'),
    (('<fixed name="damping"', '<fixed name="elasticity"'), '<fixed>.*elasticity.*twice'),
    (('<parameter name="friction" value="', '<parameter name="friction" value="1e9'), '<parameter>.*value'),
    (('<parameter name="friction" value="', '<parameter name="friction" value="x'), '<parameter>.*value'),
    (('<parameter name="friction"', '<parameter'), '<parameter>.*name'),
    (('score="', 'score="nan'), 'score'),
    (('<point x="0.0"', '<point x="inf"'), '<point>.*x'),
    (('seed="1"', 'seed="1.5"'), '<search>.*seed'),
    (('mass="', 'mass="-'), 'mass'),
    (('identifiable="', 'identifiable="per'), 'identifiable'),
    (('<options>', '<options>text'), '<options>.*text'),
    (('<warnings/>', '<warnings/><warnings/>'), '<warnings>'),
    (('<warnings/>', ''), '<warnings>'),
    (('<warnings/>', '<warnings/><?do something?>'), 'calibration_result'),
    (('name="seed" value="1"', 'name="seed" value="{"'), '<option>'),
])
def test_unexpected_is_refused_by_the_name_of_its_element(file, change, match):
    text = file.read_text(encoding='utf-8')
    changed = text.replace(*change, 1)
    assert changed != text
    file.write_text(changed, encoding='utf-8')
    refused(file, match)


@pytest.mark.parametrize('attribute', ['value', 'length', 'search', 'x'])
def test_missing_attribute_is_named(file, attribute):
    tree = etree.parse(str(file))
    name = 'name' if attribute == 'search' else attribute
    element = tree.find('search') if attribute == 'search' else tree.find(f'.//*[@{name}]')
    del element.attrib[name]
    tree.write(str(file))
    refused(file, f'<{element.tag}>.*{name}')


def with_doctype(file, doctype, insert='', attribute=''):
    text = file.read_text(encoding='utf-8').split('\n', 1)[1]
    if attribute:
        text = text.replace('engine="toy"', f'engine="{attribute}"')
    file.write_text(f'{doctype}\n{text.replace("<warnings/>", f"<warnings/>{insert}")}', encoding='utf-8')


def test_external_entity_is_refused_and_not_read(file, tmp_path):
    secret = tmp_path / 'secret.txt'
    secret.write_text('the secret')
    with_doctype(file, f'<!DOCTYPE calibration_result [<!ENTITY s SYSTEM "{secret.as_uri()}">]>', '&s;')
    with pytest.raises(InputError) as caught:
        read_result(file)
    assert 'the secret' not in str(caught.value)


def test_entity_in_an_attribute_is_refused(file):
    with_doctype(file, '<!DOCTYPE calibration_result [<!ENTITY e "toy">]>', attribute='&e;')
    refused(file, 'document type')


def test_external_dtd_is_refused(file, tmp_path):
    (tmp_path / 'some.dtd').write_text('<!ATTLIST dlo colour CDATA "red">')
    with_doctype(file, '<!DOCTYPE calibration_result SYSTEM "some.dtd">')
    refused(file, 'document type')


@pytest.mark.parametrize('attribute', [False, True])
def test_billion_laughs_are_refused(file, attribute):
    laughs = ''.join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(12))
    with_doctype(file, f'<!DOCTYPE calibration_result [<!ENTITY l0 "ha">{laughs}]>',
                 '' if attribute else '&l12;', '&l12;' if attribute else '')
    refused(file, 'result file')


@pytest.mark.parametrize('octets', [
    b'', b'<', b'no xml', b'\xff\xfe\0', b'<robot/>', b'<calibration_result version="1"/>', b'<a>' * 5000])
def test_what_is_no_result_is_refused(tmp_path, octets):
    path = tmp_path / 'result.xml'
    path.write_bytes(octets)
    refused(path, 'result file')


def test_path_without_file_is_refused(tmp_path):
    refused(tmp_path / 'missing.xml', 'missing.xml')
    refused(tmp_path, 'result file')


def test_place_that_cannot_be_written_is_refused(tmp_path, result):
    with pytest.raises(InputError, match='result.xml'):
        write_result(tmp_path / 'missing' / 'result.xml', result)


@settings(max_examples=200, deadline=None)
@given(place=st.floats(0, 1), octets=st.binary(max_size=6))
def test_damaged_anywhere_is_read_or_refused(tmp_path_factory, result, place, octets):
    document = bytearray(result_document(result, OPTIONS.flat()))
    at = int(place * len(document))
    document[at:at + len(octets)] = octets
    path = tmp_path_factory.mktemp('damaged') / 'result.xml'
    path.write_bytes(document)
    try:
        read_result(path)
    except InputError as error:
        assert str(path) in str(error)
