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


"""
Result file: what a calibration found, as an XML document.

Numbers are written so that reading gives the same floating-point values.  A
document is read by a parser that fetches nothing and expands no entities, and
anything in it that is not expected is refused.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
import json
import math
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any, Mapping

from lxml import etree

from dlo_calibration.calibration import CalibrationResult, ParameterEstimate
from dlo_calibration.chain import Chain, Floats
from dlo_calibration.errors import InputError
from dlo_calibration.parameters import ParameterSpace
from dlo_calibration.score import PointErrors

VERSION = '1'
ROOT = 'calibration_result'
MAXIMUM_SIZE = 64 * 2**20  # bytes; a result takes some kilobytes
NOT_XML = re.compile('[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')

ESTIMATE_NUMBERS = ('value', 'std', 'lower', 'upper', 'physical_value', 'physical_lower', 'physical_upper')
ERROR_NUMBERS = tuple(one.name for one in fields(PointErrors))

#: Each element's attributes, and the elements in it.
LAYOUT: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    ROOT: (('version',), ('dlo', 'parameters', 'search', 'fit', 'options', 'warnings')),
    'dlo': (('mass', 'length'), ('point',)),
    'point': (('x', 'y', 'z'), ()),
    'parameters': ((), ('parameter', 'fixed')),
    'parameter': (('name', *ESTIMATE_NUMBERS, 'physical_unit', 'identifiable'), ()),
    'fixed': (('name', 'value'), ()),
    'search': (('name', 'engine', 'seed', 'evaluations', 'simulations', 'seconds', 'stop_reason'), ()),
    'fit': (('score', *ERROR_NUMBERS), ('trial',)),
    'trial': (('name', 'score'), ()),
    'options': ((), ('option',)),
    'option': (('name', 'value'), ()),
    'warnings': ((), ('warning',)),
    'warning': (('text',), ()),
}


@dataclass(frozen=True)
class ResultFile:
    """
    What a result file says.

    :param parameters: the found ones, in the order of the calibration.
    :param fixed: values of others on the 0..100 scale; those not named keep their default.
    :param mass: kg of the whole DLO; 0 where it was not known.
    :param length: mean length of the DLO over the trials [m].
    :param points: (n, 3) [m] the DLO at rest, before the first trial's action.
    :param options: those in force, by name; empty where they were not given.
    :param trials: names of the trials.
    :param scores: difference score of each trial.
    """

    parameters: Mapping[str, ParameterEstimate]
    fixed: Mapping[str, float]
    mass: float
    length: float
    points: Floats
    score: float
    trials: tuple[str, ...]
    scores: tuple[float, ...]
    errors: PointErrors
    search: str
    engine: str
    seed: int | None
    evaluations: int
    simulations: int
    seconds: float
    stop_reason: str
    options: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, 'points', Chain(self.points).points)
        for name in ('parameters', 'fixed', 'options'):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @classmethod
    def of(cls, result: CalibrationResult, options: Mapping[str, Any] | None = None) -> ResultFile:
        """Return what the file of a result says."""
        return cls(
            parameters=result.parameters, mass=result.space.mass,
            fixed={name: value for name, value in result.space.fixed.items()
                   if name not in result.parameters},
            length=result.length, points=result.trials[0].initial.points, score=result.best.score,
            trials=tuple(trial.name for trial in result.trials), scores=result.best.scores,
            errors=result.errors, search=result.search, engine=result.engine, seed=result.seed,
            evaluations=len(result.evaluations), simulations=result.simulations, seconds=result.seconds,
            stop_reason=result.stop_reason, options=options or {}, warnings=result.warnings)

    @property
    def values(self) -> dict[str, float]:
        """Found parameters on the 0..100 scale, by name."""
        return {name: estimate.value for name, estimate in self.parameters.items()}

    @property
    def space(self) -> ParameterSpace:
        """The parameters that were found, and where the others stayed."""
        return ParameterSpace(tuple(self.parameters), self.fixed, self.mass)

    def physical(self) -> dict[str, float]:
        """Every parameter's physical value in SI units, exactly as they were in the best evaluation."""
        return self.space.physical(self.values, self.length)


def result_document(result: CalibrationResult | ResultFile,
                    options: Mapping[str, Any] | None = None) -> bytes:
    """Return a result as an XML document in UTF-8."""
    file = result if isinstance(result, ResultFile) else ResultFile.of(result, options)
    root = etree.Element(ROOT, version=VERSION)
    dlo = _add(root, 'dlo', mass=file.mass, length=file.length)
    for x, y, z in file.points:
        _add(dlo, 'point', x=x, y=y, z=z)
    parameters = _add(root, 'parameters')
    for estimate in file.parameters.values():
        _add(parameters, 'parameter', **asdict(estimate))
    for name, value in file.fixed.items():
        _add(parameters, 'fixed', name=name, value=value)
    _add(root, 'search', name=file.search, engine=file.engine, seed=file.seed, evaluations=file.evaluations,
         simulations=file.simulations, seconds=file.seconds, stop_reason=file.stop_reason)
    fit = _add(root, 'fit', score=file.score, **asdict(file.errors))
    for name, score in zip(file.trials, file.scores, strict=True):
        _add(fit, 'trial', name=name, score=score)
    chosen = _add(root, 'options')
    for name, value in sorted(file.options.items()):
        _add(chosen, 'option', name=name, value=json.dumps(value))
    warnings = _add(root, 'warnings')
    for text in file.warnings:
        _add(warnings, 'warning', text=text)
    etree.indent(root)
    return bytes(etree.tostring(root, xml_declaration=True, encoding='UTF-8')) + b'\n'


def write_result(path: str | Path, result: CalibrationResult | ResultFile,
                 options: Mapping[str, Any] | None = None) -> None:
    """
    Write a result, and the options in force, to an XML file.

    :raises InputError: where the file cannot be written.
    """
    document = result_document(result, options)
    try:
        Path(path).write_bytes(document)
    except OSError as error:
        raise InputError(f'result file {path}', str(error), 'a place that can be written to',
                         'choose another output directory') from error


def read_result(path: str | Path) -> ResultFile:
    """
    Read a result file.

    :raises InputError: where it cannot be read, or is not such a document;
        the text names the element.
    """
    where = f'result file {path}'
    try:
        with Path(path).open('rb') as stream:
            text = stream.read(MAXIMUM_SIZE + 1)
    except (OSError, ValueError) as error:
        raise InputError(where, str(error), 'a result.xml', 'check the path') from error
    if len(text) > MAXIMUM_SIZE:
        raise InputError(where, f'more than {MAXIMUM_SIZE} bytes', 'a result.xml', 'check the path')
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False,
                             huge_tree=False, remove_comments=True)
    try:
        root = etree.fromstring(text, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InputError(where, f'no XML document ({error})', 'a result.xml as this package writes it',
                         'write it again') from error
    if root.getroottree().docinfo.doctype:
        raise InputError(where, 'a document type declaration', 'a document without one',
                         'remove the <!DOCTYPE ...>')
    return _Reading(where).result(root)


def _add(parent: Any, tag: str, **attributes: Any) -> Any:
    return etree.SubElement(parent, tag, {name: _text(value) for name, value in attributes.items()})


def _text(value: Any) -> str:
    """Return a value as text from which it can be read back exactly."""
    if value is None:
        return 'none'
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, (int, str)):
        return NOT_XML.sub('\ufffd', str(value))
    return repr(float(value))


class _Reading:
    """Reads a document's elements; every refusal names the element."""

    def __init__(self, where: str) -> None:
        self._where = where

    def result(self, root: Any) -> ResultFile:
        if root.tag != ROOT:
            raise self._refused(root, f'<{root.tag}>', f'<{ROOT}>', 'name a result.xml')
        if root.get('version') != VERSION:
            raise self._refused(root, f'version {root.get("version")!r}', f'version {VERSION!r}',
                                'read it with the version of this package that wrote it')
        self._check(root)
        dlo, parameters, search, fit, options, warnings = (self._child(root, tag) for tag in LAYOUT[ROOT][1])
        seed = search.get('seed')
        estimates = self._named(parameters, 'parameter', self._estimate)
        for fixed in parameters.findall('fixed'):
            if fixed.get('name') in estimates:
                raise self._refused(fixed, f'{fixed.get("name")!r}, which is a found parameter too', 'either')
        try:
            file = ResultFile(
                parameters=estimates,
                fixed=self._named(parameters, 'fixed', lambda one: self._number(one, 'value')),
                mass=self._number(dlo, 'mass'), length=self._number(dlo, 'length'),
                points=[[self._number(point, axis) for axis in 'xyz'] for point in dlo],  # type: ignore
                score=self._number(fit, 'score'),
                trials=tuple(trial.get('name') for trial in fit),
                scores=tuple(self._number(trial, 'score') for trial in fit),
                errors=PointErrors(**{name: self._number(fit, name) for name in ERROR_NUMBERS}),
                search=search.get('name'), engine=search.get('engine'),
                seed=None if seed == 'none' else self._integer(search, 'seed'),
                evaluations=self._integer(search, 'evaluations'),
                simulations=self._integer(search, 'simulations'), seconds=self._number(search, 'seconds'),
                stop_reason=search.get('stop_reason'), options=self._named(options, 'option', self._json),
                warnings=tuple(warning.get('text') for warning in warnings))
            file.space.point(file.values)
        except InputError as error:
            if error.thing.startswith(self._where):
                raise
            raise InputError(f'{self._where}: {error.thing}', error.came, error.expected,
                             error.remedy) from error
        if not file.mass >= 0 or not file.length > 0:
            raise self._refused(dlo, f'mass {file.mass:g} kg, length {file.length:g} m',
                                'a mass of 0 or more, a length above 0', 'correct them')
        return file

    def _refused(self, element: Any, came: str, expected: str,
                 remedy: str = 'correct the file') -> InputError:
        line = f', line {element.sourceline}' if element.sourceline else ''
        return InputError(f'{self._where}, element <{element.tag}>{line}', came, expected, remedy)

    def _check(self, element: Any) -> None:
        """Refuse what the layout does not name, here and below."""
        attributes, children = LAYOUT[element.tag]
        for name in element.attrib:
            if name not in attributes:
                raise self._refused(element, f'attribute {name!r}', f'only {", ".join(attributes) or "none"}')
        for name in attributes:
            if name not in element.attrib:
                raise self._refused(element, f'no attribute {name!r}', f'{", ".join(attributes)}')
        if (element.text or '').strip():
            raise self._refused(element, f'text {element.text.strip()[:40]!r}', 'no text')
        for child in element:
            if child.tag not in children:
                name = f'<{child.tag}>' if isinstance(child.tag, str) else str(child)
                raise self._refused(element, name,
                                    ', '.join(f'<{tag}>' for tag in children) or 'nothing in it')
            if (child.tail or '').strip():
                raise self._refused(element, f'text {child.tail.strip()[:40]!r}', 'no text')
            self._check(child)

    def _child(self, element: Any, tag: str) -> Any:
        found = element.findall(tag)
        if len(found) != 1:
            raise self._refused(element, f'{len(found)} elements <{tag}>', 'one')
        return found[0]

    def _named(self, parent: Any, tag: str, value: Any) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for element in parent.findall(tag):
            name = element.get('name')
            if name in found:
                raise self._refused(element, f'the name {name!r} twice', 'each name once')
            found[name] = value(element)
        return found

    def _estimate(self, element: Any) -> ParameterEstimate:
        numbers = {name: self._number(element, name) for name in ESTIMATE_NUMBERS}
        if not 0 <= numbers['value'] <= 100:
            raise self._refused(element, f'value {numbers["value"]:g}', '0 to 100')
        identifiable = element.get('identifiable')
        if identifiable not in ('true', 'false'):
            raise self._refused(element, f'identifiable {identifiable!r}', "'true' or 'false'")
        return ParameterEstimate(name=element.get('name'), physical_unit=element.get('physical_unit'),
                                 identifiable=identifiable == 'true', **numbers)

    def _number(self, element: Any, name: str) -> float:
        text = element.get(name)
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self._refused(element, f'{name} {text[:40]!r}', 'a finite number')
        return number

    def _integer(self, element: Any, name: str) -> int:
        text = element.get(name)
        if not re.fullmatch('-?[0-9]{1,18}', text):
            raise self._refused(element, f'{name} {text[:40]!r}', 'an integer')
        return int(text)

    def _json(self, element: Any) -> Any:
        try:
            return json.loads(element.get('value'))
        except (ValueError, RecursionError) as error:
            raise self._refused(element, f'value {element.get("value")[:40]!r}', 'a JSON value') from error
