# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Description: the definition of a DLO as an XML document.

It contains the chain with annotations, the parameters with units and intervals, the
mass, and the calibration that found them.  The node publishes it, and result.xml holds it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from itertools import combinations
import math
from pathlib import Path
from types import MappingProxyType
from typing import Any, Mapping, Sequence

from dlo_calibration.calibration.automatic import DECIDED
from dlo_calibration.calibration.file_options import FileOptions
from dlo_calibration.calibration.plain import plain
from dlo_calibration.calibration.result import CalibrationResult, ParameterEstimate
from dlo_calibration.errors import InputError
from dlo_calibration.files.xml import (
    add,
    add_chain,
    add_options,
    document,
    new_root,
    number,
    parse,
    read_chain,
    read_octets,
    read_options,
    refused,
    text_of,
    write_octets,
)
from dlo_calibration.inference.confirmation import Confirmation
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace, SCALE
from dlo_calibration.model.score import PointErrors

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
    :param options: options of the calibration, by name; empty where they were not given.
    :param choice: which parameters `calibrate` auto has chosen, and why; empty where they were named.
    :param unusable: why the parameters should not be used, in words; empty: they can be.
    :param trials: names of the trials.
    :param scores: difference score of each trial [cm].
    :param confirmation: fit of a second engine with the same parameters; None: there was no second engine.
    :param problems: a text for each option in the file that is left out, and one if it should not be used.
    :param refusal: why the scene in the file is not among the options.
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
    options: Mapping[str, Any] = field(default_factory=dict)
    choice: str = ''
    unusable: str = ''
    warnings: tuple[str, ...] = ()
    confirmation: Confirmation | None = None
    problems: tuple[str, ...] = ()
    refusal: InputError | None = None

    def __post_init__(self) -> None:
        for name in ('parameters', 'fixed', 'options'):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @classmethod
    def of(cls, result: CalibrationResult, options: Mapping[str, Any] | None = None) -> Description:
        """Return the definition of the DLO that a calibration found."""
        space, told = result.space, plain(result)
        fixed = {p.name: space.fixed.get(p.name, p.default) for p in space.parameters
                 if p.name not in result.parameters and (p.name != 'mass' or 'mass' in space.fixed)}
        decided = result.choice.options.flat() if result.choice else {}
        return cls(
            parameters=result.parameters, mass=space.mass, fixed=fixed,
            length=result.length, chain=result.trials[0].initial, score=result.best.score,
            trials=tuple(trial.name for trial in result.trials), scores=result.best.scores,
            errors=result.errors, correlations=result.correlations,
            options={name: decided.get(name, value) if name in DECIDED else value
                     for name, value in (options or {}).items()},
            warnings=result.warnings, confirmation=result.confirmation, **{key: told[key] for key in HOW})

    @property
    def file_options(self) -> FileOptions:
        """The options, with what was left out of them."""
        return FileOptions(self.options, self.problems, self.refusal)

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


def description_document(found: CalibrationResult | Description,
                         options: Mapping[str, Any] | None = None) -> bytes:
    """Return the definition of a DLO as an XML document in UTF-8."""
    dlo = found if isinstance(found, Description) else Description.of(found, options)
    space = dlo.space
    root = new_root('dlo')
    root.set('mass', text_of(dlo.mass))
    root.set('length', text_of(dlo.length))
    add_chain(root, 'chain', dlo.chain)
    parameters = add(root, 'parameters')
    for estimate in dlo.parameters.values():
        words = {name: getattr(estimate, name) or None for name in ('verdict', 'note')}  # None is left out
        add(parameters, 'found', **{**asdict(estimate), **words})
    for name, value in dlo.fixed.items():
        physical, unit = space.reported(name, value)
        add(parameters, 'fixed', name=name, value=value, physical_value=physical, physical_unit=unit)
    if dlo.correlations is not None:
        correlations = add(parameters, 'correlations')
        for one, other in combinations(dlo.parameters, 2):
            add(correlations, 'correlation', first=one, second=other, value=dlo.correlations[one][other])
    how = {key: getattr(dlo, key) for key in HOW}
    calibration = add(root, 'calibration', **{key: 'none' if one is None else one
                                              for key, one in how.items()})
    _add_fit(calibration, 'fit', dlo, dlo.trials)
    if dlo.confirmation is not None:
        _add_fit(calibration, 'confirmation', dlo.confirmation, dlo.trials)
    add_options(calibration, 'options', dlo.options)
    warnings = add(calibration, 'warnings')
    for text in dlo.warnings:
        add(warnings, 'warning', text=text)
    return document(root)


def write_result(path: str | Path, result: CalibrationResult | Description,
                 options: Mapping[str, Any] | None = None) -> None:
    """
    Write a result, and the options of its calibration, to an XML file.

    :raises InputError: where the file cannot be written.
    """
    write_octets(path, description_document(result, options))


def read_result(path: str | Path) -> Description:
    """
    Read a result file.

    :raises InputError: where the file cannot be read, or is not a valid result;
        the text names the line and the element.
    """
    return read_description(read_octets(path, WHAT, 'a result.xml'), f'{WHAT} {path}', Path(path).parent)


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
    root = parse(octets, where, 'dlo')
    chain, parameters, calibration = root
    fit, *second, options, warnings = calibration
    given = read_options(where, options, folder)
    seed, unusable = calibration.get('seed'), calibration.get('unusable', '')
    try:
        dlo = Description(
            parameters=_estimates(where, parameters), fixed=_fixed(where, parameters),
            mass=number(where, root, 'mass'), length=number(where, root, 'length'),
            chain=read_chain(where, chain), score=number(where, fit, 'score'),
            trials=tuple(trial.get('name') for trial in fit),
            scores=tuple(number(where, trial, 'score') for trial in fit),
            errors=_errors(where, fit),
            search=calibration.get('search'), engine=calibration.get('engine'),
            seed=None if seed == 'none' else int(seed), evaluations=int(calibration.get('evaluations')),
            simulations=int(calibration.get('simulations')), seconds=number(where, calibration, 'seconds'),
            stop_reason=calibration.get('stop_reason'), correlations=_correlations(where, parameters),
            options=given.values, choice=calibration.get('choice', ''), unusable=unusable,
            problems=(*([f'do not use this result: {unusable}'] if unusable else []), *given.problems),
            refusal=given.refusal,
            warnings=tuple(warning.get('text') for warning in warnings),
            confirmation=_confirmation(where, second[0]) if second else None)
        space = dlo.space
    except InputError as error:
        if error.thing.startswith(where):
            raise
        raise refused(where, parameters, f'{error.thing}: {error.came}', error.expected,
                      error.remedy) from error
    if not dlo.mass >= 0 or not dlo.length > 0:
        raise refused(where, root, f'mass {dlo.mass:g} kg, length {dlo.length:g} m',
                      'a mass of 0 or more, a length above 0', 'correct them')
    for element in parameters.findall('fixed'):
        _check_physical(where, element, space)
    return dlo


def _add_fit(calibration: Any, tag: str, found: Description | Confirmation, trials: Sequence[str]) -> None:
    """Add the score and errors of all trials, and the score of each, by the first or a second engine."""
    other = vars(found) if isinstance(found, Confirmation) else {}
    element = add(calibration, tag, engine=other.get('engine'), score=found.score, **asdict(found.errors),
                  mean_distance=other.get('mean_distance'), max_distance=other.get('max_distance'))
    for name, score in zip(trials, found.scores, strict=True):
        add(element, 'trial', name=name, score=score)


def _confirmation(where: str, element: Any) -> Confirmation:
    return Confirmation(
        engine=element.get('engine'), score=number(where, element, 'score'),
        scores=tuple(number(where, trial, 'score') for trial in element), errors=_errors(where, element),
        mean_distance=number(where, element, 'mean_distance'),
        max_distance=number(where, element, 'max_distance'))


def _errors(where: str, element: Any) -> PointErrors:
    return PointErrors(**{one.name: number(where, element, one.name) for one in fields(PointErrors)})


def _estimates(where: str, parameters: Any) -> dict[str, ParameterEstimate]:
    found: dict[str, ParameterEstimate] = {}
    for element in parameters.findall('found'):
        name = element.get('name')
        numbers = {one: number(where, element, one) for one in (
            'value', 'std', 'lower', 'upper', 'physical_value', 'physical_lower', 'physical_upper')}
        if name in found:
            raise refused(where, element, f'the name {name!r} twice', 'each name once')
        if not 0 <= numbers['value'] <= SCALE:
            raise refused(where, element, f'value {numbers["value"]:g}', '0 to 100')
        found[name] = ParameterEstimate(
            name, **numbers, physical_unit=element.get('physical_unit'),
            identifiable=element.get('identifiable') == 'true', verdict=element.get('verdict', ''),
            note=element.get('note', ''))
    return found


def _fixed(where: str, parameters: Any) -> dict[str, float]:
    names = {element.get('name') for element in parameters.findall('found')}
    fixed: dict[str, float] = {}
    for element in parameters.findall('fixed'):
        name = element.get('name')
        if name in names:
            raise refused(where, element, f'the name {name!r} twice', 'each name once, found or fixed')
        names.add(name)
        fixed[name] = number(where, element, 'value')
        if not 0 <= fixed[name] <= SCALE:
            raise refused(where, element, f'value {fixed[name]:g}', '0 to 100')
    return fixed


def _correlations(where: str, parameters: Any) -> dict[str, dict[str, float]] | None:
    element = parameters.find('correlations')
    if element is None:
        return None
    names = [found.get('name') for found in parameters.findall('found')]
    found = {name: {name: 1.0} for name in names}
    for one in element:
        pair, value = (one.get('first'), one.get('second')), number(where, one, 'value')
        if pair[0] == pair[1] or not found.keys() >= set(pair):
            raise refused(where, one, f'the pair {pair[0]!r}, {pair[1]!r}', 'two found parameters')
        if pair[1] in found[pair[0]]:
            raise refused(where, one, f'the pair {pair[0]!r}, {pair[1]!r} twice', 'each pair once')
        if not -1 <= value <= 1:
            raise refused(where, one, f'value {value:g}', '-1 to 1')
        found[pair[0]][pair[1]] = found[pair[1]][pair[0]] = value
    pairs = len(names) * (len(names) - 1) // 2
    if len(element) != pairs:
        raise refused(where, element, f'{len(element)} correlations', f'{pairs}, one for each pair',
                      'add the others, or leave all out')
    return found


def _check_physical(where: str, element: Any, space: ParameterSpace) -> None:
    """Refuse a value and a physical value that differ by more than rounding."""
    physical, unit = space.reported(element.get('name'), number(where, element, 'value'))
    given = number(where, element, 'physical_value')
    if not math.isclose(given, physical, rel_tol=1e-3) or element.get('physical_unit') != unit:
        raise refused(where, element, f'{given:g} {element.get("physical_unit")} for the value '
                      f'{element.get("value")}', f'{physical:g} {unit}', 'change both')
