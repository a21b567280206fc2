# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
XML: documents that are read safely, checked by their schema, and written in one form.

A document is in UTF-8.  The reader refuses document type declarations, entities,
processing instructions, namespaces (they could name a schema elsewhere), and more
bytes, depth or elements than a valid document needs, before it uses any content.
It loads no other file.  Comments are allowed, and dropped.

The schemas check elements, attributes and types.  The modules of the documents check what schemas cannot
express, such as a physical value that contradicts its value.

The written form has the attributes in the order of the schema, two blanks per
level, and each number as the shortest text that reads back as the same number.
"""

from __future__ import annotations

from contextlib import contextmanager, suppress
from dataclasses import fields
import math
from pathlib import Path
import re
from typing import Any, Iterator, Mapping, Sequence

from lxml import etree
import numpy as np

from dlo_calibration import reading
from dlo_calibration.calibration.options import file_options, FileOptions, Options, recordable
from dlo_calibration.errors import InputError, suggestion
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import exact, from_first_scale, owner, SCALE

SCHEMAS = Path(__file__).parent / 'schema'
MAXIMUM_SIZE = 32 * 2**20  # bytes; more than any real request needs, and small enough for the memory
MAXIMUM_ELEMENTS = 500_000  # likewise
MAXIMUM_DEPTH = 16  # the schemas need less than half
MAXIMUM_ATTRIBUTES = 100  # of an element; the schemas need a fifth
PIECE = 2**14  # bytes that are parsed at once

#: First two characters of a pattern in the schemas -> its meaning.
PATTERNS = {'[+': 'a finite number', '-?': 'an integer', '\\S': 'a name without blanks'}


def read_octets(path: str | Path, what: str, expected: str) -> bytes:
    """
    Read a file, up to one byte more than the largest allowed document.

    :raises InputError: where it cannot be read.
    """
    return reading.read_octets(Path(path), f'{what} {path}', expected, MAXIMUM_SIZE)


def parse(octets: bytes, where: str, schema: str) -> Any:
    """
    Return the root element of a document that is valid by a schema.

    :param where: name of the document in errors, e.g. ``file result.xml``.
    :param schema: name of the schema and of the root element.
    :raises InputError: where it is not valid; the text names the line and the error there.
    """
    _check_octets(octets, where)
    checker = etree.XMLSchema(etree.parse(str(SCHEMAS / f'{schema}.xsd')))
    safe = {'encoding': 'utf-8', 'resolve_entities': False, 'no_network': True, 'load_dtd': False,
            'dtd_validation': False, 'attribute_defaults': False, 'huge_tree': False, 'remove_comments': True}
    parser = etree.XMLPullParser(events=('start', 'end', 'pi'), **safe)
    # lxml counts the elements before each error, which takes hours for many errors.  So this second parser,
    # without a tree, finds the first error, and reading ends with its piece.
    early = etree.XMLParser(target=_NoTree(), schema=checker, **safe)
    guard = _Guard(where)
    try:
        for begin in range(0, len(octets), PIECE):  # the guard sees a piece before the next one is parsed
            parser.feed(octets[begin:begin + PIECE])
            guard.check(parser.read_events())
            with suppress(etree.XMLSyntaxError):  # the first parser raises it, too
                early.feed(octets[begin:begin + PIECE])
            if early.feed_error_log:
                break
        else:
            parser.close()
    except (etree.XMLSyntaxError, ValueError, AssertionError) as error:
        guard.check(parser.read_events())
        line, text = next(((entry.line, entry.message) for entry in parser.feed_error_log),
                          (0, str(error)))
        raise InputError(f'{where}, line {line}' if line else where, f'no XML document ({text})',
                         f'a document <{schema}>', 'write it again') from error
    guard.check(parser.read_events())
    root = guard.root
    if root.tag != schema:
        raise refused(where, root, f'the root element <{root.tag}>', f'<{schema}>', f'name a <{schema}> file')
    if not checker.validate(root):
        raise _schema_error(where, checker.error_log[0], schema)
    if root.get('version') == '1':
        _upgrade(root)
    return root


def _upgrade(root: Any) -> None:
    """Bring the flexibility in a document of version 1 to today's scale."""
    start = from_first_scale(0.0)
    for element in root.iter('found', 'fixed', 'option'):
        if owner(element.get('name'))[0] != 'flexibility':
            continue
        for name in ('value', 'lower', 'upper', 'std'):
            with suppress(TypeError, ValueError):  # it is absent, or refused as it is
                value = float(element.get(name))
                if name == 'std':
                    element.set(name, exact(from_first_scale(value) - start))
                elif 0 <= value <= SCALE and (name, value) != ('lower', 0.0):
                    # An interval that reached the end of the scale is open there, and stays so.
                    element.set(name, exact(from_first_scale(value)))


def document(root: Any) -> bytes:
    """
    Return the document with a root element, as UTF-8 bytes.

    Control characters, which a terminal or an editor would obey, are written as references.
    """
    etree.indent(root)
    text = etree.tostring(root, encoding='unicode')
    text = re.sub('[\x7f-\x9f\u2028-\u202e\u2066-\u2069]', lambda match: f'&#{ord(match[0])};', text)
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{text}\n".encode()


def refused(where: str, element: Any, came: str, expected: str,
            remedy: str = 'correct the file') -> InputError:
    """Return the error that refuses an element."""
    line = f', line {element.sourceline}' if element.sourceline else ''
    return InputError(f'{where}{line}, element <{element.tag}>', came, expected, remedy)


@contextmanager
def located(where: str, element: Any) -> Iterator[None]:
    """Let the errors of a block name the element that was read, unless they name their place already."""
    try:
        yield
    except InputError as error:
        if error.thing.startswith(where):
            raise
        raise refused(where, element, f'{error.thing}: {error.came}', error.expected,
                      error.remedy) from error


def new_root(tag: str, **attributes: Any) -> Any:
    """Return the root element of a new document."""
    return etree.Element(tag, {name: text_of(value) for name, value in attributes.items()})


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
    return _finite(where, element, name, element.get(name))


def attributes(where: str, element: Any, record: Any) -> dict[str, Any]:
    """Return an element's attributes that are fields of a dataclass, each in the type of its field."""
    return {field.name: _value(where, element, field.name, str(field.type)) for field in fields(record)
            if field.name in element.attrib}


def _value(where: str, element: Any, name: str, kind: str) -> Any:
    """Return an attribute as a `kind`, the type of its field in a dataclass."""
    text = element.get(name)
    if kind == 'str':
        return text
    words = text.split()
    if kind == 'bool':
        return words == ['true']
    if kind.startswith('int'):
        return None if words == ['none'] else int(text)
    if kind.startswith('tuple[str'):
        return tuple(words)
    if kind.startswith('tuple[int'):
        return tuple(map(int, words))
    if kind.startswith('Numbers'):
        return tuple(_finite(where, element, name, word) for word in words)
    return _finite(where, element, name, text)


def _finite(where: str, element: Any, name: str, text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise refused(where, element, f'{name} {text!r}', 'a number below 1.8e308')
    return value


def add_points(element: Any, chain: Chain) -> None:
    """Add the points of a chain, with their annotations."""
    hands = [None] * len(chain) if chain.hands is None else chain.hands.tolist()
    for (x, y, z), hand, feature, seen in zip(chain.points.tolist(), hands, chain.features.tolist(),
                                              chain.seen.tolist(), strict=True):
        add(element, 'point', x=x, y=y, z=z, hand=hand, feature=feature or None, seen=None if seen else False)


def read_chain(where: str, element: Any) -> Chain:
    """Return the chain that an element contains."""
    points = element.findall('point')
    annotated = [point.get('hand') for point in points]
    if None in annotated and any(hand is not None for hand in annotated):
        point = points[annotated.index(None)]
        raise refused(where, point, "no attribute 'hand'",
                      'the attribute at all points of the chain, or at none')
    with located(where, element):
        return Chain(read_vectors(where, points),
                     None if None in annotated else np.array([int(hand) for hand in annotated], np.uint8),
                     np.array([point.get('feature') == 'true' for point in points]),
                     np.array([point.get('seen') != 'false' for point in points]))


def read_vectors(where: str, element: Any) -> Floats:
    """Return the attributes x y z of all children of an element, or of a list of elements, (n, 3)."""
    return np.array([[number(where, child, axis) for axis in 'xyz'] for child in element], dtype=float)


def add_options(parent: Any, tag: str, flat: Mapping[str, Any]) -> None:
    """Add options by name, in the order of their declarations, without those of the machine."""
    element, flat = add(parent, tag), recordable(flat)
    for declaration in Options.declarations():
        if declaration.name in flat:
            add(element, 'option', name=declaration.name, value=flat[declaration.name])


def read_options(where: str, element: Any, folder: Path | None) -> FileOptions:
    """
    Return the options of a document, checked by their declarations, without those that no file may set.

    :param folder: of the document; None if it is no file.
    """
    declarations = {declaration.name: declaration for declaration in Options.declarations()}
    given: dict[str, Any] = {}
    for option in element:
        name, text = option.get('name'), option.get('value')
        if name in given:
            raise refused(where, option, f'the name {name!r} twice', 'each name once')
        with located(where, option):
            given[name] = declarations[name].read(text) if name in declarations else None
            Options.of({name: given[name]})
    return file_options({name: list(value) if isinstance(value, tuple) else value
                         for name, value in given.items()}, folder)


class _NoTree:
    """A parser's target that builds no tree."""

    def close(self) -> None:
        """Return nothing."""


class _Guard:
    """Checks the elements of a document while it is parsed."""

    def __init__(self, where: str) -> None:
        self._where = where
        self.root: Any = None
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
                                 f'a processing instruction <?{element.target}?>', 'none',
                                 'remove it')
            if self.root is None:
                self.root = element
            self._depth += 1
            self._count += 1
            if self._depth > MAXIMUM_DEPTH:
                raise refused(self._where, element, f'elements nested more than {MAXIMUM_DEPTH} deep',
                              'a document that this package writes')
            if self._count > MAXIMUM_ELEMENTS:
                raise refused(self._where, element, f'more than {MAXIMUM_ELEMENTS} elements', 'fewer',
                              'use several files')
            if len(element.attrib) > MAXIMUM_ATTRIBUTES:
                raise refused(self._where, element, f'more than {MAXIMUM_ATTRIBUTES} attributes', 'fewer',
                              'write it again')
            for name in (element.tag, *element.attrib):
                if name.startswith('{'):
                    raise refused(self._where, element, f'{name}, which is in a namespace',
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


def _schema_error(where: str, entry: Any, schema: str) -> InputError:
    """Return an InputError for the first error of the schema."""
    expected = f'a document that {schema}.xsd allows'
    match = re.match(r"Element '([^']*)'(?:, attribute '([^']*)')?: (.*)", ' '.join(entry.message.split()))
    if match is None:
        return InputError(f'{where}, line {entry.line}', entry.message, expected, 'correct the file')
    tag, attribute, text = match.groups()
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
    return InputError(f'{where}, line {entry.line}, element <{tag}>', came.rstrip('.'),
                      expected, _remedy(tag, attribute, text, expected))


def _remedy(tag: str, attribute: str | None, text: str, expected: str) -> str:
    """Return the remedy for the first error of the schema: the name that was probably meant, if any."""
    value = re.match(r"The value '(.*)' is not$", text)
    permitted = re.findall(r'[\w-]+', expected.removeprefix('one of '))
    if value:
        return suggestion(value[1], permitted, 'correct the file')
    kind, name = ('attribute', attribute) if attribute else ('element', tag)
    names = _names(kind)
    if name in names or attribute and 'not allowed' not in text:  # misplaced, not misspelt
        return 'correct the file'
    return suggestion(name, names if attribute else permitted, 'correct the file')


def _names(kind: str) -> set[str]:
    """Return the names of all elements, or attributes, in the schemas."""
    return {element.get('name') for path in SCHEMAS.glob('*.xsd')
            for element in etree.parse(str(path)).iter(f'{{http://www.w3.org/2001/XMLSchema}}{kind}')
            if element.get('name')}
