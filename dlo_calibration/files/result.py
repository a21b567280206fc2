# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Description: the definition of a DLO as an XML document.

It contains the chain with annotations, the parameters with units and intervals, the
mass, and the calibration that found them.  The node publishes it, and result.xml holds it.
"""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, replace
from itertools import combinations
import math
from pathlib import Path
from types import MappingProxyType
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.choice import DECIDED
from dlo_calibration.calibration.options import FileOptions
from dlo_calibration.calibration.passport import Passport, UNKNOWN
from dlo_calibration.calibration.result import CalibrationResult, evaluation_rows, ParameterEstimate, plain
from dlo_calibration.files import xml
from dlo_calibration.inference.examination import Confirmation
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace, SCALE, SCALES
from dlo_calibration.model.score import PointErrors
from dlo_calibration.writing import whole, write_file

WHAT = 'result file'  # in errors
#: Attributes of the calibration, in the order of the document.
HOW = ('search', 'engine', 'seed', 'evaluations', 'simulations', 'seconds', 'stop_reason', 'choice',
       'unusable')


@dataclass(frozen=True)
class Description:
    """
    The definition of a DLO.

    :param parameters: the found parameters, in the order of the calibration.
    :param fixed: values of others on the 0..100 scale; the rest keep their defaults.
    :param mass: of the whole DLO [kg]; 0: unknown.
    :param length: mean length of the DLO over the trials [m].
    :param chain: the DLO at rest, before the first trial's action, with its annotations.
    :param correlations: of each pair of found parameters, by name, -1 to 1; None: they are unknown.
    :param file_options: options of the calibration; none where they were not given.
    :param choice: the parameters that `calibrate` auto has chosen, and why; empty where they were named.
    :param unusable: why the parameters should not be used, in words; empty: they can be.
    :param trials: names of the trials.
    :param scores: difference score of each trial [cm].
    :param confirmation: fit of a second engine with the same parameters; None: there was no second engine.
    :param passport: where the result comes from; an empty one: unknown.
    """

    parameters: Mapping[str, ParameterEstimate]
    fixed: Mapping[str, float]
    mass: float
    length: float
    chain: Chain
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
    correlations: Mapping[str, Mapping[str, float]] | None = None
    file_options: FileOptions = FileOptions()
    choice: str = ''
    unusable: str = ''
    warnings: tuple[str, ...] = ()
    confirmation: Confirmation | None = None
    passport: Passport = UNKNOWN

    def __post_init__(self) -> None:
        for name in ('parameters', 'fixed'):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @classmethod
    def of(cls, result: CalibrationResult, options: Mapping[str, Any] | None = None,
           passport: Passport = UNKNOWN) -> Description:
        """Return the definition of the DLO that a calibration found."""
        space, values = result.space, plain(result)
        fixed = {p.name: space.fixed.get(p.name, p.default) for p in space.parameters
                 if p.name not in result.parameters and (p.name != 'mass' or 'mass' in space.fixed)}
        decided = result.choice.options.flat() if result.choice else {}
        return cls(
            parameters=result.parameters, mass=space.mass, fixed=fixed,
            length=result.length, chain=result.trials[0].initial, score=result.best.score,
            trials=tuple(trial.name for trial in result.trials), scores=result.best.scores,
            errors=result.errors, correlations=result.correlations,
            file_options=FileOptions({name: decided.get(name, value) if name in DECIDED else value
                                      for name, value in (options or {}).items()}),
            warnings=result.warnings, confirmation=result.confirmation, passport=passport,
            **{key: values[key] for key in HOW})

    @property
    def values(self) -> dict[str, float]:
        """Found parameters on the 0..100 scale, by name."""
        return {name: estimate.value for name, estimate in self.parameters.items()}

    @property
    def space(self) -> ParameterSpace:
        """The found parameters, and the values of the others."""
        return ParameterSpace(tuple(self.parameters), self.fixed, self.mass)

    def physical(self) -> dict[str, float]:
        """Return the physical value of every parameter, in SI units, exactly as in the best evaluation."""
        return self.space.physical(self.values, self.length)


def description_document(result: CalibrationResult | Description,
                         options: Mapping[str, Any] | None = None, passport: Passport = UNKNOWN) -> bytes:
    """Return the definition of a DLO as an XML document in UTF-8."""
    dlo = result if isinstance(result, Description) else Description.of(result, options, passport)
    space = dlo.space
    root = xml.new_root('dlo', version=SCALES, mass=dlo.mass, length=dlo.length)
    xml.add_points(xml.add(root, 'chain'), dlo.chain)
    parameters = xml.add(root, 'parameters')
    for estimate in dlo.parameters.values():
        words = {name: getattr(estimate, name) or None for name in ('verdict', 'note')}  # None is left out
        xml.add(parameters, 'found', **{**asdict(estimate), **words})
    for name, value in dlo.fixed.items():
        physical, unit = space.reported(name, value)
        xml.add(parameters, 'fixed', name=name, value=value, physical_value=physical, physical_unit=unit)
    if dlo.correlations is not None:
        correlations = xml.add(parameters, 'correlations')
        for first, second in combinations(dlo.parameters, 2):
            xml.add(correlations, 'correlation', first=first, second=second,
                    value=dlo.correlations[first][second])
    how = {key: getattr(dlo, key) for key in HOW}
    calibration = xml.add(root, 'calibration', **{key: 'none' if value is None else value
                                                  for key, value in how.items()})
    _add_fit(calibration, 'fit', dlo, dlo.trials)
    if dlo.confirmation is not None:
        _add_fit(calibration, 'confirmation', dlo.confirmation, dlo.trials)
    xml.add_options(calibration, 'options', dlo.file_options.values)
    warnings = xml.add(calibration, 'warnings')
    for text in dlo.warnings:
        xml.add(warnings, 'warning', text=text)
    if dlo.passport != UNKNOWN:
        words = {name: value for name, value in vars(dlo.passport).items() if name != 'sessions'}
        element = xml.add(calibration, 'passport', **words)
        for name, sha256 in dlo.passport.sessions.items():
            xml.add(element, 'session', name=name, sha256=sha256)
    return xml.document(root)


def write_result(path: str | Path, result: CalibrationResult | Description,
                 options: Mapping[str, Any] | None = None, passport: Passport = UNKNOWN) -> None:
    """
    Write a result, and the options of its calibration, to an XML file.

    :raises InputError: where the file cannot be written.
    """
    write_file(path, description_document(result, options, passport))


def write_evaluations(path: Path, result: CalibrationResult) -> None:
    """
    Write every evaluation as a row of a CSV file; see `evaluation_rows`.

    :raises InputError: where the file cannot be written.
    """
    head, rows = evaluation_rows(result)
    with whole(path) as new, new.open('w', newline='', encoding='utf-8') as stream:
        csv.writer(stream).writerows([head, *rows])


def read_result(path: str | Path) -> Description:
    """
    Read a result file.

    :raises InputError: where the file cannot be read, or is not a valid result;
        the text names the line and the element.
    """
    return read_description(xml.read_octets(path, WHAT, 'a result.xml'), f'{WHAT} {path}', Path(path).parent)


def read_description(octets: bytes | str, where: str = 'dlo_description',
                     folder: Path | None = None) -> Description:
    """
    Read the definition of a DLO from its document, e.g. the text of the message `dlo_description`.

    :param where: name of the document in errors.
    :param folder: of the document, in which its scene may lie.
    :raises InputError: where it is not a valid definition.
    """
    if isinstance(octets, str):
        octets = octets.encode('utf-8', 'surrogatepass')
    root = xml.parse(octets, where, 'dlo')
    chain, parameters, calibration = root
    fit, *second = calibration.findall('fit') + calibration.findall('confirmation')
    options, warnings = calibration.find('options'), calibration.find('warnings')
    passport = _passport(where, calibration)
    given = xml.read_options(where, options, folder)
    if unusable := calibration.get('unusable'):
        given = replace(given, warnings=(f'do not use this result: {unusable}', *given.warnings))
    if passport.warning:
        given = replace(given, warnings=(passport.warning, *given.warnings))
    with xml.located(where, parameters):
        dlo = Description(
            **xml.attributes(where, root, Description), **xml.attributes(where, calibration, Description),
            **_fit(where, fit, Description), parameters=_estimates(where, parameters),
            fixed=_fixed(where, parameters), correlations=_correlations(where, parameters),
            chain=xml.read_chain(where, chain), trials=tuple(trial.get('name') for trial in fit),
            file_options=given, passport=passport,
            warnings=tuple(warning.get('text') for warning in warnings),
            confirmation=Confirmation(**_fit(where, second[0], Confirmation)) if second else None)
        space = dlo.space
    if not dlo.mass >= 0 or not dlo.length > 0:
        raise xml.refused(where, root, f'mass {dlo.mass:g} kg, length {dlo.length:g} m',
                      'a mass of 0 or more, a length above 0', 'correct them')
    for element in parameters.findall('fixed'):
        _check_physical(where, element, space)
    return dlo


def _passport(where: str, calibration: Any) -> Passport:
    element = calibration.find('passport')
    if element is None:
        return UNKNOWN
    return replace(Passport(**xml.attributes(where, element, Passport)), sessions={
        session.get('name'): session.get('sha256') for session in element})


def _add_fit(calibration: Any, tag: str, fit: Description | Confirmation, trials: Sequence[str]) -> None:
    """Add the score and errors of all trials, and the score of each, by the first or a second engine."""
    other = vars(fit) if isinstance(fit, Confirmation) else {}
    element = xml.add(calibration, tag, engine=other.get('engine'), score=fit.score, **asdict(fit.errors),
                      mean_distance=other.get('mean_distance'), max_distance=other.get('max_distance'))
    for name, score in zip(trials, fit.scores, strict=True):
        xml.add(element, 'trial', name=name, score=score)


def _fit(where: str, element: Any, record: type[Description | Confirmation]) -> dict[str, Any]:
    """Return what `_add_fit` wrote, as the fields of a record."""
    return {**xml.attributes(where, element, record),
            'scores': tuple(xml.number(where, trial, 'score') for trial in element),
            'errors': PointErrors(**xml.attributes(where, element, PointErrors))}


def _estimates(where: str, parameters: Any) -> dict[str, ParameterEstimate]:
    estimates: dict[str, ParameterEstimate] = {}
    for element in parameters.findall('found'):
        estimate = ParameterEstimate(**xml.attributes(where, element, ParameterEstimate))
        if estimate.name in estimates:
            raise xml.refused(where, element, f'the name {estimate.name!r} twice', 'each name once')
        if not 0 <= estimate.value <= SCALE:
            raise xml.refused(where, element, f'value {estimate.value:g}', '0 to 100')
        estimates[estimate.name] = estimate
    return estimates


def _fixed(where: str, parameters: Any) -> dict[str, float]:
    names = {element.get('name') for element in parameters.findall('found')}
    fixed: dict[str, float] = {}
    for element in parameters.findall('fixed'):
        name = element.get('name')
        if name in names:
            raise xml.refused(where, element, f'the name {name!r} twice', 'each name once, found or fixed')
        names.add(name)
        fixed[name] = xml.number(where, element, 'value')
        if not 0 <= fixed[name] <= SCALE:
            raise xml.refused(where, element, f'value {fixed[name]:g}', '0 to 100')
    return fixed


def _correlations(where: str, parameters: Any) -> dict[str, dict[str, float]] | None:
    element = parameters.find('correlations')
    if element is None:
        return None
    names = [estimate.get('name') for estimate in parameters.findall('found')]
    correlations = {name: {name: 1.0} for name in names}
    for correlation in element:
        first, second = correlation.get('first'), correlation.get('second')
        value = xml.number(where, correlation, 'value')
        if first == second or not correlations.keys() >= {first, second}:
            raise xml.refused(where, correlation, f'the pair {first!r}, {second!r}', 'two found parameters')
        if second in correlations[first]:
            raise xml.refused(where, correlation, f'the pair {first!r}, {second!r} twice', 'each pair once')
        if not -1 <= value <= 1:
            raise xml.refused(where, correlation, f'value {value:g}', '-1 to 1')
        correlations[first][second] = correlations[second][first] = value
    pairs = len(names) * (len(names) - 1) // 2
    if len(element) != pairs:
        raise xml.refused(where, element, f'{len(element)} correlations', f'{pairs}, one for each pair',
                      'add the others, or leave all out')
    return correlations


def _check_physical(where: str, element: Any, space: ParameterSpace) -> None:
    """Refuse a value and a physical value that differ by more than rounding."""
    physical, unit = space.reported(element.get('name'), xml.number(where, element, 'value'))
    given = xml.number(where, element, 'physical_value')
    if not math.isclose(given, physical, rel_tol=1e-3) or element.get('physical_unit') != unit:
        raise xml.refused(where, element, f'{given:g} {element.get("physical_unit")} for the value '
                      f'{element.get("value")}', f'{physical:g} {unit}', 'change both')
