# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Options: declared once, here.

ROS parameters with descriptors and ranges, command-line flags, and the options
recorded in a session are all generated from these declarations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from typing import Any, Iterator, Mapping, Sequence

from dlo_calibration.errors import InputError, shortened
from dlo_calibration.evaluation.processes import ANSWER_LIMIT
from dlo_calibration.model.parameters import (
    BY_NAME,
    MOST_PARTS,
    PAPER_PARAMETERS,
    PARAMETERS,
    ParameterSpace,
    SCALE,
)
from dlo_calibration.model.quantity import measured
from dlo_calibration.search import SEARCHES
from dlo_calibration.simulation.protocol import DEFAULT_NODES, DEFAULT_TIME_STEP

AUTO = 'auto'  # engine: the fastest one that supports the options; the confirming one checks its result
CONFIRMING = 'bullet'

#: What an option describes: how trials were observed; what is searched and simulated; the user's machine.
#: Files never set those of the machine (`file_options`). The mass belongs to the search, though it was
#: measured: `validate` takes it from the result, as all physical values are in proportion to it.
OBSERVATION, SEARCH, MACHINE = 'observation', 'search', 'machine'


@dataclass(frozen=True)
class Declaration:
    """
    One option, with all that ROS and the command line need to declare it.

    :param default: also gives the type of the option: bool, int, float, str, or tuple of str.
    :param choices: the permitted values of a str, or of each str of a tuple.
    :param of: OBSERVATION, SEARCH, or MACHINE, which does not affect the result, and which no file sets.
    """

    name: str
    default: Any
    description: str
    of: str
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()

    def checked(self, value: Any) -> Any:
        """
        Return `value` in the option's own type.

        :raises InputError: if it has another type, or is out of range.
        """
        kind = type(self.default)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if kind is tuple and isinstance(value, (list, tuple)):
            value = tuple(value)
        what = f'parameter {self.name}'
        if type(value) is not kind or kind is tuple and not all(isinstance(v, str) for v in value):
            names = {bool: 'true or false', int: 'an integer', float: 'a number', str: 'a text',
                     tuple: 'a list of names'}
            raise InputError(what, f'{value!r}', names[kind], 'give it that type')
        if self.choices:
            for one in value if kind is tuple else (value,):
                if one not in self.choices:
                    raise InputError(what, f'{one!r}', _one_of(self.choices, one), 'choose one of them')
        low, high = self.minimum, self.maximum
        if kind in (int, float) and not (
                (low is None or value >= low) and (high is None or value <= high)):
            raise InputError(what, f'{value:g} {self.unit}'.rstrip(),
                             f'{"" if low is None else f"{low:g}"} to {"" if high is None else f"{high:g}"}'
                             f' {self.unit}'.rstrip(), 'choose a value in that range')
        return value


def _option(default: Any, description: str, of: str, **rest: Any) -> Any:
    return field(default=default, metadata={'description': description, 'of': of, **rest})


@dataclass(frozen=True)
class Options:
    """
    Everything that a user can set; the declarations state meaning, unit and range.

    `values` holds the fixed value of every parameter except the mass, on the 0..100
    scale; it is used if the parameter is not calibrated. Each is an option with the
    name of the parameter.
    """

    mass: float = _option(
        0.0, 'mass of the whole DLO; 0: unknown, so a density is assumed and stiffness is reported '
        'relative to weight', unit='kg', minimum=0.0, maximum=1000.0, of=SEARCH)
    table: bool = _option(True, 'whether there is a table', of=OBSERVATION)
    table_height: float = _option(0.0, 'height of the table top', unit='m', minimum=-100.0, maximum=100.0,
                                  of=OBSERVATION)
    scene: str = _option(
        '', 'path of a URDF file with fixed obstacles that the DLO can touch, in addition to the table; '
        'relative to the working directory; a session or document can name only a file in its own folder; '
        'empty: no obstacles', of=OBSERVATION)
    calibrate: tuple[str, ...] = _option(
        PAPER_PARAMETERS, 'names of the parameters to find; all others keep their fixed value',
        choices=tuple(BY_NAME), of=SEARCH)
    parts: int = _option(
        1, 'number of parts of equal length, each with its own bending stiffness; 0: chosen by '
        'cross-validation; if flexibility is calibrated, so is the stiffness of every part; a higher '
        'part that calibrate names raises the number', minimum=0, maximum=MOST_PARTS, of=SEARCH)
    search: str = _option('least_squares', 'method that chooses the parameter sets to try',
                          choices=tuple(SEARCHES), of=SEARCH)
    evaluations: int = _option(
        150, "largest number of parameter sets to try (the paper's rounds)", minimum=1,
        maximum=1000000, of=SEARCH)
    seed: int = _option(1, 'random seed; the same seed gives the same result', minimum=0, maximum=2**31 - 1,
                        of=SEARCH)
    engine: str = _option(
        AUTO, 'simulation engine; auto: search with compiled and confirm the result with bullet, or use '
        'bullet alone if there is a scene', choices=(AUTO, CONFIRMING, 'compiled'), of=SEARCH)
    workers: int = _option(0, 'number of simulation processes; 0: one per core', minimum=0, maximum=1024,
                           of=MACHINE)
    scheduler: str = _option(
        '', 'address of a Dask scheduler, e.g. tcp://host:8786; its workers then simulate, on any number of '
        'machines, and the option workers has no effect; empty: simulate on this machine', of=MACHINE)
    answer_limit: float = _option(
        ANSWER_LIMIT, 'time without a sign of life after which a process that simulates is replaced and its '
        'evaluation is repeated', unit='s', minimum=1.0, maximum=86400.0, of=MACHINE)
    nodes: int = _option(DEFAULT_NODES, 'number of point masses of the simulated DLO', minimum=8,
                         maximum=1000, of=SEARCH)
    time_step: float = _option(DEFAULT_TIME_STEP, 'simulation time step', unit='s', minimum=0.0001,
                               maximum=0.02, of=SEARCH)
    stable_distance: float = _option(
        0.0005, 'the DLO is stable when all its nodes moved less than this within stable_time',
        unit='m', minimum=1e-6, maximum=0.1, of=SEARCH)
    stable_time: float = _option(0.25, 'time over which stable_distance is measured', unit='s',
                                 minimum=0.01, maximum=60.0, of=SEARCH)
    settle_limit: float = _option(10.0, 'simulated time after which waiting for a stable DLO ends',
                                  unit='s', minimum=0.1, maximum=600.0, of=SEARCH)
    grip_tolerance: float = _option(
        0.02, 'an action without annotated grip is refused if no point is this near to the hand',
        unit='m', minimum=0.0, maximum=10.0, of=OBSERVATION)
    length_tolerance: float = _option(
        50.0, 'a goal chain is refused if its length differs by more than this from the initial chain',
        unit='%', minimum=0.0, maximum=1000.0, of=OBSERVATION)
    release: bool = _option(
        True, 'whether a hand opens at its last waypoint; used if goal chains have no hand field',
        of=OBSERVATION)
    start_after_trials: int = _option(
        0, 'number of trials after which calibration starts by itself; 0: wait for ~/start', minimum=0,
        maximum=1000000, of=MACHINE)
    output_directory: str = _option('.', 'folder for the session and the result', of=MACHINE)
    record: bool = _option(True, 'whether to record the session', of=MACHINE)
    values: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for declaration in declarations():
            if declaration.name in FIXED_VALUES:
                continue
            object.__setattr__(self, declaration.name, declaration.checked(getattr(self, declaration.name)))
        given = {name: FIXED_VALUES[name].checked(value) if name in FIXED_VALUES else _unknown(name)
                 for name, value in self.values.items()}
        object.__setattr__(
            self, 'values', {name: given.get(name, d.default) for name, d in FIXED_VALUES.items()})
        ParameterSpace(self.calibrate)  # refuses an empty list and a name given twice

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Options:
        """
        Build from a flat mapping of option names to values.

        :raises InputError: for an unknown name, a wrong type, or a value out of range.
        """
        known = {declaration.name for declaration in declarations()}
        for name in options:
            if name not in known:
                _unknown(name)
        return cls(**{name: value for name, value in options.items() if name not in FIXED_VALUES},
                   values={name: value for name, value in options.items() if name in FIXED_VALUES})

    def flat(self) -> dict[str, Any]:
        """Return all options by name, as `of` takes them; tuples as lists."""
        flat = {d.name: self.values[d.name] if d.name in FIXED_VALUES else getattr(self, d.name)
                for d in declarations()}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in flat.items()}

    @property
    def space(self) -> ParameterSpace:
        """The parameters to find, and the fixed values of the others."""
        parts = max(self.parts, ParameterSpace(self.calibrate).parts)
        return ParameterSpace(self.calibrate, self.values, self.mass).divided(parts)


def _unknown(name: str) -> Any:
    known = [declaration.name for declaration in declarations()]
    raise InputError('parameter', repr(name), _one_of(known, name), 'correct the name')


def _one_of(known: Sequence[str], name: str) -> str:
    """Say that one of the known names was expected: all of them, or the nearest ones if there are many."""
    if len(known) <= 8:  # they fit into an error
        return f'one of {", ".join(known)}'
    near = get_close_matches(shortened(name), known, n=3, cutoff=0)
    return f'one of {", ".join(near)} or {len(known) - len(near)} others in doc/messages.md'


FIXED_VALUES: Mapping[str, Declaration] = {
    p.name: Declaration(
        p.name, p.default, f'{p.description}: {p.quantity} from {measured(p.at_zero, p.unit)} (at 0) to '
        f'{measured(p.at_hundred, p.unit)} (at 100), {"linear" if p.linear else "logarithmic"}; '
        'used if it is not calibrated',
        of=SEARCH, minimum=0.0, maximum=SCALE)
    for p in PARAMETERS if p.name != 'mass'}  # the mass is an option in kg


def declarations() -> Iterator[Declaration]:
    """Yield the declaration of every option, in the order in which they are shown."""
    for option in fields(Options):
        if option.name != 'values':
            yield Declaration(option.name, option.default, **option.metadata)
    yield from FIXED_VALUES.values()


def names_of(kind: str) -> tuple[str, ...]:
    """Return the names of the options of a kind: OBSERVATION, SEARCH or MACHINE."""
    return tuple(declaration.name for declaration in declarations() if declaration.of == kind)
