# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Reading XML: what is no document of ours is refused in one line, before anything is made of it."""

from contextlib import closing
import socket
import threading
import time

from hypothesis import given
from hypothesis import strategies as st
from lxml import etree
import numpy as np
import pytest
from random_examples import drawing

from dlo_calibration.calibration.options import FileOptions
from dlo_calibration.errors import InputError
from dlo_calibration.files import xml
from dlo_calibration.files.request import GoalRequest, Request, request_of, TrialRequest
from dlo_calibration.files.xml import MAXIMUM_SIZE, parse, text_of
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.named_actions import LiftAndHold

STRAIGHT = Chain(np.column_stack([np.linspace(0, 0.6, 4), np.zeros(4), np.zeros(4)]))
REQUEST = Request((TrialRequest('one', STRAIGHT, (LiftAndHold(point=1),), (GoalRequest(STRAIGHT, 2.0),)),),
                  FileOptions({'mass': 0.03}), 'rope')
TEXT = REQUEST.document.decode()
HEAD, BODY = TEXT.split('\n', 1)
NAMED = 'calibration_request'


def refused(octets, match=None):
    """Return the refusal of a document, which takes one line and names the document."""
    with pytest.raises(InputError, match=match) as caught:
        parse(octets.encode() if isinstance(octets, str) else octets, 'file evil.xml', NAMED)
    refusal = str(caught.value)
    assert refusal.startswith('file evil.xml')
    assert '\n' not in refusal and len(refusal) < 1000
    return refusal


def changed(old, new):
    assert old in TEXT
    return TEXT.replace(old, new, 1)


def test_the_document_itself_is_read():
    assert parse(TEXT.encode(), 'x', NAMED).get('version') == '2'
    assert parse(b'\xef\xbb\xbf' + TEXT.encode(), 'x', NAMED).tag == NAMED  # with a mark of the byte order
    assert parse(BODY.encode(), 'x', NAMED).tag == NAMED
    commented = changed('<settings/>', '<!-- said by\nnobody --><settings/>')
    assert request_of(commented.encode()).document == TEXT.encode()


def test_external_entity_is_refused_and_not_read(tmp_path):
    secret = tmp_path / 'secret.txt'
    secret.write_text('the secret')
    evil = f'<!DOCTYPE {NAMED} [<!ENTITY s SYSTEM "{secret.as_uri()}">]>\n{BODY}'
    refusal = refused(evil.replace('<settings/>', '<settings>&s;</settings>'), 'line 1: .*DOCTYPE')
    assert 'the secret' not in refusal


@pytest.mark.parametrize('doctype', [
    f'<!DOCTYPE {NAMED} [<!ENTITY e "rope">]>', f'<!DOCTYPE {NAMED} SYSTEM "some.dtd">',
    f'<!DOCTYPE {NAMED} PUBLIC "-//X//Y" "http://127.0.0.1:9/some.dtd">',
    f'<!DOCTYPE {NAMED} [<!ATTLIST trial name CDATA "x">]>', '<!DOCTYPE\n x>'])
def test_document_type_is_refused_by_its_line(doctype):
    refused(f'{HEAD}\n\n{doctype}\n{BODY.replace(">", " >")}', 'line 3: a document type declaration')
    refused(f'{HEAD}\n\n{doctype}\n{BODY}'.replace('"rope"', '"&e;"'), 'line 3: a document type')


@pytest.mark.parametrize('attribute', [False, True])
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-16', 'utf-32'])
def test_billion_laughs_are_refused(attribute, encoding):
    laughs = ''.join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(12))
    body = BODY.replace('name="one"', 'name="&l12;"') if attribute else BODY.replace(
        '<settings/>', '<settings>&l12;</settings>')
    evil = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE x [<!ENTITY l0 "ha">{laughs}]>{body}'
    refused(evil.encode(encoding))


def test_entity_that_nobody_declared_is_refused():
    refused(changed('name="rope"', 'name="&rope;"'), 'line 3')


@pytest.mark.parametrize('encoding', ['utf-16', 'utf-32', 'utf-7', 'cp037', 'latin-1'])
def test_other_encodings_are_refused_or_read_as_utf_8(encoding):
    text = changed("encoding='UTF-8'", f"encoding='{encoding}'").replace('name="one"', 'name="é+ADw-"')
    refused(text.encode(encoding, 'replace').replace(b'?>', b' ?>', 1).replace(b'<settings/>', b'<settings>'))


def test_bytes_that_are_no_text_are_refused_by_their_line():
    refused(TEXT.encode().replace(b'rope', b'r\xffpe'), 'line 3: bytes that are not UTF-8')


@pytest.mark.parametrize('insert', [
    '<x:include xmlns:x="http://www.w3.org/2001/XInclude" href="/etc/passwd"/>',
    '<settings xmlns="http://www.w3.org/2001/XMLSchema"/>'])
def test_namespace_is_refused(insert):
    refused(changed('<settings/>', insert), 'line 4, element.* in a namespace')


@pytest.mark.parametrize('attribute', ['noNamespaceSchemaLocation', 'schemaLocation'])
def test_schema_of_somebody_else_is_not_fetched(attribute):
    with closing(socket.create_server(('127.0.0.1', 0))) as server:
        met = []
        server.settimeout(0.2)

        def listen():
            try:
                met.append(server.accept())
            except TimeoutError:
                pass

        listener = threading.Thread(target=listen)
        listener.start()
        place = f'http://127.0.0.1:{server.getsockname()[1]}/evil.xsd'
        refused(changed(f'<{NAMED} ', f'<{NAMED} xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
                        f'xsi:{attribute}="{place} {place}" '), 'line 2, .*namespace')
        listener.join()
    assert met == []


@pytest.mark.parametrize('place', ['<settings/>', f'<{NAMED} ', f'</{NAMED}>'])
def test_processing_instruction_is_refused(place):
    refused(changed(place, f'<?do something?>{place}'), 'line .*processing instruction <.do.>')
    refused(f'{TEXT}<?do something?>', 'processing instruction')


@pytest.mark.parametrize('depth', [17, 1000, 100_000])
def test_depth_is_refused_before_it_is_built(depth):
    refused(f'<{NAMED}>\n' + '<a>' * depth + '</a>' * depth + f'</{NAMED}>', 'line 2')
    refused('<a>' * depth)


def test_too_many_elements_are_refused(monkeypatch):
    monkeypatch.setattr(xml, 'MAXIMUM_ELEMENTS', 1000)
    refused('<a>\n' + '<b/>' * 1000 + '</a>', 'line 2.* more than 1000')


def test_too_many_bytes_are_refused():
    refused(b'<a>' + b' ' * MAXIMUM_SIZE, f'more than {MAXIMUM_SIZE} bytes')


@pytest.mark.parametrize('insert', ['9' * 100_000, 'x' * 11_000_000, '1' * 65])
def test_long_number_is_refused(insert):
    refused(changed('z="0.0"', f'z="{insert}"'), 'line')


def test_many_attributes_are_refused():
    attributes = ' '.join(f'a{k}="0"' for k in range(2000))
    refused(changed('<settings/>', f'<settings {attributes}/>'), 'line 4')


@pytest.mark.parametrize('octets', [b'', b'<', b'no xml', b'\xff\xfe\0', b'<robot/>', f'<{NAMED}/>'.encode(),
                                    b'\0' * 100, b'<a></b>', b'<a/><a/>', b'<a b="1" b="2"/>', b'<a>'])
def test_a_file_that_is_no_document_is_refused(octets):
    refused(octets)


@drawing(60)
@given(octets=st.one_of(
    st.binary(max_size=200), st.text(alphabet='<>/!?[]&;#x0"\' =aA', max_size=80).map(str.encode)))
def test_any_bytes_are_refused(octets):
    refused(octets)


@drawing(60)
@given(place=st.floats(0, 1), octets=st.binary(max_size=6))
def test_damaged_anywhere_is_read_or_refused(place, octets):
    document = bytearray(TEXT.encode())
    at = int(place * len(document))
    document[at:at + len(octets)] = octets
    try:
        request_of(bytes(document), 'file evil.xml')
    except InputError as error:
        assert str(error).startswith('file evil.xml')
        assert '\n' not in str(error)


@given(value=st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.integers(-2**53, 2**53)))
def test_any_number_is_what_the_schema_calls_a_number(value):
    document = changed('z="0.0"', f'z="{text_of(value)}"')
    point = parse(document.encode(), 'x', NAMED).find('.//point')
    assert float(point.get('z')) == value


def test_written_form_does_not_depend_on_how_it_was_indented():
    root = etree.fromstring(TEXT.encode())
    flat = etree.tostring(root).replace(b'\n', b'').replace(b'  ', b'')
    assert request_of(flat).document == TEXT.encode()


@pytest.mark.parametrize('trials', [
    '<trial/>' * 200_000, '<trial {}/>'.format(' '.join(f'a{k}="1"' for k in range(10**5)))],
    ids=['elements', 'attributes'])
def test_a_document_in_which_very_much_is_wrong_is_refused_within_seconds(trials):
    begun = time.monotonic()
    refused(f'<calibration_request version="1"><object/><settings/>{trials}</calibration_request>', '<trial>')
    assert time.monotonic() - begun < 20
