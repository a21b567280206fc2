# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
XML: documents that are read safely, checked by their schema, and written in one form.

A document is in UTF-8.  The reader refuses document type declarations, entities,
processing instructions, namespaces (they could name a schema elsewhere), and more
bytes, depth or elements than a valid document needs, before it uses any content.
It loads no other file.  Comments are allowed, and dropped.

The written form has the attributes in the order of the schema, two blanks per
level, and each number as the shortest text that reads back as the same number.
"""

from __future__ import annotations

from importlib.resources import as_file, files
import math
from pathlib import Path
import re
from typing import Any, Iterator, Mapping, Sequence

from lxml import etree
import numpy as np

from dlo_calibration.calibration.declaration import Declaration
from dlo_calibration.calibration.file_options import file_options, FileOptions, recordable
from dlo_calibration.calibration.options import declarations, Options
from dlo_calibration.errors import InputError, meant
from dlo_calibration.files.intake import require_file
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.quantity import exact
from dlo_calibration.writing import whole

MAXIMUM_SIZE = 32 * 2**20  # bytes; far above any real request, and small enough for the memory
MAXIMUM_ELEMENTS = 500_000  # likewise
MAXIMUM_DEPTH = 16  # the schemas need less than half

#: First two characters of a pattern in the schemas -> its meaning.
PATTERNS = {'[+': 'a finite number', '-?': 'an integer', '\\S': 'a name without blanks'}


def read_octets(path: str | Path, what: str, suggestion: str) -> bytes:
    """
    Read a file, up to one byte more than the largest allowed document.

    :raises InputError: where it cannot be read.
    """
    where = f'{what} {path}'
    try:
        require_file(Path(path), where, suggestion)
        with Path(path).open('rb') as stream:
            octets = stream.read(MAXIMUM_SIZE + 1)
    except OSError as error:
        raise InputError(where, error.strerror or str(error), suggestion, 'check the path') from error
    except ValueError as error:
        raise InputError(where, str(error), suggestion, 'check the path') from error
    return octets


def parse(octets: bytes, where: str, schema: str) -> Any:
    """
    Return the root element of a document that is valid by a schema.

    :param where: name of the document in errors, e.g. ``file result.xml``.
    :param schema: name of the schema and of the root element.
    :raises InputError: where it is not valid; the text names the line and the error there.
    """
    _check_octets(octets, where)
    parser = etree.XMLPullParser(
        events=('start', 'end', 'pi'), encoding='utf-8', resolve_entities=False, no_network=True,
        load_dtd=False, dtd_validation=False, attribute_defaults=False, huge_tree=False, remove_comments=True)
    guard = _Guard(where)
    try:
        piece = 2**16  # bytes, so that the guard sees a bad document before all of it is parsed
        for begin in range(0, len(octets), piece):
            parser.feed(octets[begin:begin + piece])
            guard.check(parser.read_events())
        root = parser.close()
    except (etree.XMLSyntaxError, ValueError, AssertionError) as error:
        guard.check(parser.read_events())
        line, text = next(((entry.line, entry.message) for entry in parser.feed_error_log),
                          (0, str(error)))
        raise InputError(f'{where}, line {line}' if line else where, f'no XML document ({_short(text)})',
                         f'a document <{schema}>', 'write it again') from error
    guard.check(parser.read_events())
    if root.tag != schema:
        raise refused(where, root, f'the root element <{root.tag}>', f'<{schema}>', f'name a <{schema}> file')
    checker = _schema(schema)
    if not checker.validate(root):
        raise _schema_error(where, checker.error_log[0], schema)
    return root


def document(root: Any) -> bytes:
    """
    Return the document with a root element, as UTF-8 bytes.

    Characters that a terminal or an editor would obey stand there as references.
    """
    etree.indent(root)
    text = etree.tostring(root, encoding='unicode')
    text = re.sub('[\x7f-\x9f\u2028-\u202e\u2066-\u2069]', lambda match: f'&#{ord(match[0])};', text)
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{text}\n".encode()


def write_octets(path: str | Path, octets: bytes) -> None:
    """
    Write a document to a file.

    :raises InputError: where the file cannot be written.
    """
    with whole(Path(path)) as new:
        new.write_bytes(octets)


def refused(where: str, element: Any, came: str, expected: str,
            remedy: str = 'correct the file') -> InputError:
    """Return the error that refuses an element."""
    line = f', line {element.sourceline}' if element.sourceline else ''
    return InputError(f'{where}{line}, element <{element.tag}>', came, expected, remedy)


def new_root(tag: str) -> Any:
    """Return the root element of a new document."""
    return etree.Element(tag, version='1')


def add(parent: Any, tag: str, **attributes: Any) -> Any:
    """Add an element, without the attributes that are None."""
    return etree.SubElement(parent, tag, {name: text_of(value) for name, value in attributes.items()
                                          if value is not None})


def add_comment(parent: Any, lines: Sequence[str]) -> None:
    """Add a comment of several lines; two hyphens in a row, which XML does not allow there, become a dash."""
    text = text_of('\n'.join(('', *(f'  {line}' for line in lines), '')))
    parent.append(etree.Comment(re.sub('-(?=-)', '\N{EN DASH}', text)))


def text_of(value: Any) -> str:
    """Return a value as text that XML allows, and that reads back as the same value."""
    return re.sub('[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]', '\ufffd', exact(value))


def number(where: str, element: Any, name: str) -> float:
    """Return a numeric attribute; refuse one that is not finite."""
    return finite(where, element, name, element.get(name))


def finite(where: str, element: Any, name: str, text: str) -> float:
    """Return the number in `text`, a value of the attribute `name`; refuse one that is not finite."""
    value = float(text)
    if not math.isfinite(value):
        raise refused(where, element, f'{name} {text!r}', 'a number below 1.8e308')
    return value


def add_chain(parent: Any, tag: str, chain: Chain, **attributes: Any) -> Any:
    """Add a chain with its annotations."""
    element = add(parent, tag, **attributes)
    hands = [None] * len(chain) if chain.hands is None else chain.hands.tolist()
    for (x, y, z), hand, feature, seen in zip(chain.points.tolist(), hands, chain.features.tolist(),
                                              chain.seen.tolist(), strict=True):
        add(element, 'point', x=x, y=y, z=z, hand=hand, feature=feature or None, seen=None if seen else False)
    return element


def read_chain(where: str, element: Any) -> Chain:
    """Return the chain that an element contains."""
    annotated = [point.get('hand') for point in element]
    if None in annotated and any(hand is not None for hand in annotated):
        point = element[annotated.index(None)]
        raise refused(where, point, "no attribute 'hand'",
                      'the attribute at all points of the chain, or at none')
    try:
        return Chain(read_vectors(where, element),
                     None if None in annotated else np.array([int(hand) for hand in annotated], np.uint8),
                     np.array([point.get('feature') == 'true' for point in element]),
                     np.array([point.get('seen') != 'false' for point in element]))
    except InputError as error:
        if error.thing.startswith(where):
            raise
        raise refused(where, element, error.came, error.expected, error.remedy) from error


def read_vectors(where: str, element: Any) -> Floats:
    """Return the attributes x y z of all children of an element, (n, 3)."""
    return np.array([[number(where, one, axis) for axis in 'xyz'] for one in element], dtype=float)


def add_options(parent: Any, tag: str, flat: Mapping[str, Any]) -> None:
    """Add options by name, in the order of their declarations, without those of the machine."""
    element, flat = add(parent, tag), recordable(flat)
    for declaration in declarations():
        if declaration.name in flat:
            add(element, 'option', name=declaration.name, value=flat[declaration.name])


def read_options(where: str, element: Any, folder: Path | None) -> FileOptions:
    """
    Return the options of a document, each checked by its declaration, as far as a file may set them.

    :param folder: of the document; None: it is not a file.
    """
    known = {declaration.name: declaration for declaration in declarations()}
    found: dict[str, Any] = {}
    for option in element:
        name, text = option.get('name'), option.get('value')
        if name in found:
            raise refused(where, option, f'the name {name!r} twice', 'each name once')
        try:
            found[name] = _option(known[name], text) if name in known else None
            Options.of({name: found[name]})
        except InputError as error:
            raise refused(where, option, f'{error.thing}: {error.came}', error.expected,
                          error.remedy) from error
    return file_options({name: list(value) if isinstance(value, tuple) else value
                         for name, value in found.items()}, folder)


def _option(declaration: Declaration, text: str) -> Any:
    kind = type(declaration.default)
    try:
        if kind is bool:
            return {'true': True, 'false': False}[text]
        if kind is tuple:
            return tuple(text.split())
        return kind(text)
    except (KeyError, ValueError):
        return declaration.checked(text)  # its error names the expected type


class _Guard:
    """Checks the elements of a document while it is parsed."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._depth = 0
        self._count = 0

    def check(self, events: Iterator[tuple[str, Any]]) -> None:
        """Refuse elements that no valid document contains."""
        for event, element in events:
            if event == 'end':
                self._depth -= 1
                continue
            if event == 'pi':
                raise InputError(f'{self._where}, line {element.sourceline}',
                                 f'a processing instruction <?{_short(element.target)}?>', 'none',
                                 'remove it')
            self._depth += 1
            self._count += 1
            if self._depth > MAXIMUM_DEPTH:
                raise refused(self._where, element, f'elements nested more than {MAXIMUM_DEPTH} deep',
                              'a document that this package writes')
            if self._count > MAXIMUM_ELEMENTS:
                raise refused(self._where, element, f'more than {MAXIMUM_ELEMENTS} elements', 'fewer',
                              'use several files')
            for name in (element.tag, *element.attrib):
                if name.startswith('{'):
                    raise refused(self._where, element, f'{_short(name)}, which is in a namespace',
                                  'names without a namespace', 'remove it')


def _check_octets(octets: bytes, where: str) -> None:
    if len(octets) > MAXIMUM_SIZE:
        raise InputError(where, f'more than {MAXIMUM_SIZE} bytes', 'a smaller document', 'use several files')
    try:
        octets.decode('utf-8')
    except UnicodeDecodeError as error:
        raise InputError(f'{where}, line {_line(octets, error.start)}', 'bytes that are not UTF-8', 'UTF-8',
                         'save it in this encoding') from error
    declared = re.search(b'<!(DOCTYPE|ENTITY|ELEMENT|ATTLIST|NOTATION)', octets)
    if declared:
        raise InputError(f'{where}, line {_line(octets, declared.start())}',
                         f'a document type declaration ({declared[0].decode()} ...)',
                         'a document without one', 'remove it')


def _line(octets: bytes, place: int) -> int:
    return octets.count(b'\n', 0, place) + 1


def _short(text: str) -> str:
    text = ' '.join(text.split())
    return text if len(text) <= 200 else f'{text[:200]} ...'


def _schema(name: str) -> Any:
    with as_file(files('dlo_calibration') / 'files/schema') as folder:
        return etree.XMLSchema(etree.parse(str(folder / f'{name}.xsd')))


def _schema_error(where: str, entry: Any, schema: str) -> InputError:
    """Return an error in our words for the first error that the schema found."""
    expected = f'a document that {schema}.xsd allows'
    found = re.match(r"Element '([^']*)'(?:, attribute '([^']*)')?: (.*)", ' '.join(entry.message.split()))
    if found is None:
        return InputError(f'{where}, line {entry.line}', _short(entry.message), expected, 'correct the file')
    tag, attribute, text = found.groups()
    text = re.sub(r'^\[facet .*?\] ', '', text)
    for pattern, wanted in (
            (r"The value '(.*)' is not accepted by the pattern '(..).*", None),
            (r"(The value '.*' is not) an element of the set \{(.*)\}\.", 'one of {}'),
            (r"('.*' is not a valid value) of the (?:\w+) type '(.*)'\.", 'a value of the type {}'),
            (r'(.*) Expected is (?:one of )?\( (.*) \)\.', '{}')):
        match = re.fullmatch(pattern, text)
        if match:
            text = match[1] if wanted else repr(match[1])
            expected = wanted.format(match[2]) if wanted else PATTERNS.get(match[2], expected)
            break
    came = f'attribute {attribute!r}: {text}' if attribute else text
    return InputError(f'{where}, line {entry.line}, element <{tag}>', _short(came.rstrip('.')),
                      _short(expected), _remedy(tag, attribute, text, expected))


def _remedy(tag: str, attribute: str | None, text: str, expected: str) -> str:
    """Return what to do about the first error of the schema: use the name that was probably meant."""
    value = re.match(r"The value '(.*)' is not$", text)
    permitted = re.findall(r'[\w-]+', expected.removeprefix('one of '))
    if value:
        return meant(value[1], permitted, 'correct the file')
    kind, name = ('attribute', attribute) if attribute else ('element', tag)
    known = _names(kind)
    if name in known or attribute and 'not allowed' not in text:  # it is not misspelt, but in a wrong place
        return 'correct the file'
    return meant(name, known if attribute else permitted, 'correct the file')


def _names(kind: str) -> set[str]:
    """Return the names of all elements, or attributes, in the schemas."""
    with as_file(files('dlo_calibration') / 'files/schema') as folder:
        return {one.get('name') for path in folder.glob('*.xsd')
                for one in etree.parse(str(path)).iter(f'{{http://www.w3.org/2001/XMLSchema}}{kind}')
                if one.get('name')}
