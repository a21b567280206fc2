# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Options: declared once, here.

ROS parameters with descriptors and ranges, command-line flags, and the options recorded in a session are all
generated from these declarations. All options that come out of a session, a request or a result pass through
`file_options`: a file may come from a stranger, so it never chooses machines, processes or folders, and names
no file outside its own folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any, Mapping, NoReturn, Self, Sequence

from dlo_calibration.errors import InputError, one_of, suggestion
from dlo_calibration.model.parameters import (
    BY_NAME,
    HANDS,
    measured,
    MOST_PARTS,
    MOST_SESSIONS,
    own_name,
    OWN_SHAPE,
    PAPER_PARAMETERS,
    PARAMETERS,
    ParameterSpace,
    PART_NAMES,
    REST_STATE,
    SCALE,
    STIFFNESS_KNOTS,
)
from dlo_calibration.model.pose import NUMBERS, Pose
from dlo_calibration.search import SEARCHES
from dlo_calibration.simulation.protocol import DEFAULT_NODES, DEFAULT_TIME_STEP

#: What an option describes: how trials were observed; what is searched and simulated; or the user's machines,
#: computer and robot, which no file configures (`file_options`). The mass belongs to the search, though it is
#: measured: `validate` takes it from the result, because all physical values are proportional to it.
OBSERVATION, SEARCH, MACHINE = 'observation', 'search', 'machine'


@dataclass(frozen=True)
class Declaration:
    """
    One option, with all that ROS and the command line need to declare it.

    :param default: also gives the type of the option: bool, int, float, str, or tuple of str.
    :param choices: the permitted values of a str, or of each str of a tuple.
    :param of: OBSERVATION, SEARCH, or MACHINE, which no file sets.
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
        if kind is tuple and isinstance(value, str):
            value = (value,)
        what = f'parameter {self.name}'
        if type(value) is not kind or kind is tuple and not all(isinstance(v, str) for v in value):
            names = {bool: 'true or false', int: 'an integer', float: 'a number', str: 'a text',
                     tuple: 'a list of names' if self.choices else 'a list of texts'}
            raise InputError(what, f'{value!r}', names[kind], 'give it that type')
        if self.choices:
            for choice in value if kind is tuple else (value,):
                if choice not in self.choices:
                    raise InputError(what, f'{choice!r}', one_of(self.choices, choice),
                                     suggestion(choice, self.choices, 'choose one of them'))
        low, high = self.minimum, self.maximum
        if kind in (int, float) and not (
                (low is None or value >= low) and (high is None or value <= high)):
            raise InputError(what, f'{value:g} {self.unit}'.rstrip(),
                             f'{"" if low is None else f"{low:g}"} to {"" if high is None else f"{high:g}"}'
                             f' {self.unit}'.rstrip(), 'choose a value in that range')
        return value

    def read(self, text: str) -> Any:
        """Return the value that a text gives, unchecked; the text itself if it gives none."""
        kind = type(self.default)
        try:
            return {'true': True, 'false': False}[text] if kind is bool else \
                tuple(text.split()) if kind is tuple else kind(text)
        except (KeyError, ValueError):
            return text


def declared(default: Any, description: str, of: str, **rest: Any) -> Any:
    """Return a dataclass field that declares an option; its arguments are those of `Declaration`."""
    return field(default=default, metadata={'description': description, 'of': of, **rest})


@dataclass(frozen=True)
class DeclaredOptions:
    """
    Base class of options: frozen dataclasses with a field for each option, see `declared`.

    Command-line flags, ROS parameters and parameter files are generated from their declarations.
    """

    def __post_init__(self) -> None:
        for option in self.declarations():
            if hasattr(self, option.name):
                object.__setattr__(self, option.name, option.checked(getattr(self, option.name)))

    @classmethod
    @cache
    def declarations(cls) -> tuple[Declaration, ...]:
        """Return the declaration of every option, in the order in which they are shown."""
        return tuple(Declaration(option.name, option.default, **option.metadata)
                     for option in fields(cls) if option.metadata)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """
        Build from a flat mapping of option names to values.

        :raises InputError: for an unknown name, a wrong type, or a value out of range.
        """
        names = [option.name for option in cls.declarations()]
        for name in options:
            if name not in names:
                refuse_name(name, names)
        return cls._built(options)

    @classmethod
    def _built(cls, options: Mapping[str, Any]) -> Self:
        return cls(**options)

    def flat(self) -> dict[str, Any]:
        """Return all options by name, as `of` takes them; tuples as lists."""
        values = {option.name: self._value(option.name) for option in self.declarations()}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def _value(self, name: str) -> Any:
        return getattr(self, name)

    def check_together(self) -> None:
        """
        Check several options together.

        :raises InputError: if they contradict each other.
        """


def refuse_name(name: str, names: Sequence[str]) -> NoReturn:
    """Raise the InputError for an option with an unknown name."""
    raise InputError('parameter', repr(name), f'{one_of(names, name)} in doc/messages.md',
                     suggestion(name, names, 'correct the name'))


#: The options that a simulation needs.
SIMULATION = ('table', 'table_height', 'scene', 'engine', 'nodes', 'time_step', 'stable_distance',
              'stable_time', 'settle_limit', 'answer_limit')
AUTO = 'auto'  # calibrate: see `choice`; engine: the fastest one that supports the options, see CONFIRMING
CONFIRMING = 'bullet'  # the engine that checks the result of `auto`


def _hand_shift(axis: str) -> Any:
    parameter = BY_NAME[f'hand_shift_{axis}']
    return declared(0.0, f'{parameter.description}; used if it is not calibrated', unit='m',
                    minimum=parameter.at_zero, maximum=parameter.at_hundred, of=OBSERVATION)


@dataclass(frozen=True)
class Options(DeclaredOptions):
    """
    Everything that a user can set; the declarations state meaning, unit and range.

    `values` holds the fixed value of every parameter except the mass, on the 0..100
    scale; it is used if the parameter is not calibrated. Each is an option with the
    name of the parameter.
    """

    mass: float = declared(
        0.0, 'mass of the whole DLO; 0: unknown: forces on hands tell it, else a density is assumed and '
        'stiffness is reported relative to weight', unit='kg', minimum=0.0, maximum=1000.0, of=SEARCH)
    table: bool = declared(True, 'whether there is a table', of=OBSERVATION)
    table_height: float = declared(0.0, 'height of the table top', unit='m', minimum=-100.0, maximum=100.0,
                                   of=OBSERVATION)
    frame_pose: str = declared(
        '', "pose of the chains' and actions' frame in the table's frame, whose z is up: x y z [m] and a "
        'quaternion qx qy qz qw, e.g. 0 0 -0.75 0 0 0 1; or, for the node where tf2_ros is installed, the '
        "name of the table's frame, whose transform it looks up; empty: they are the same frame",
        of=OBSERVATION)
    scene: str = declared(
        '', 'path of a URDF file with fixed obstacles that the DLO can touch, in addition to the table; '
        'relative to the working directory; a session or document can name only a file in its own folder; '
        'empty: no obstacles', of=OBSERVATION)
    hand_delay: float = declared(
        0.0, 'by how much the stamps of actions are late, negative: early; used if it is not calibrated',
        unit='s', minimum=BY_NAME['hand_delay'].at_zero, maximum=BY_NAME['hand_delay'].at_hundred,
        of=OBSERVATION)
    hand_shift_x: float = _hand_shift('x')
    hand_shift_y: float = _hand_shift('y')
    hand_shift_z: float = _hand_shift('z')
    slow_chain_error: float = declared(
        0.0, 'standard deviation of errors that neighbouring points of a chain share, as those of a film; '
        'they widen the intervals as far as they move the values; 0: none; of several sessions, the largest '
        'counts', unit='m', minimum=0.0, maximum=0.1, of=OBSERVATION)
    slow_hand_error: float = declared(
        0.0, 'standard deviation of the place along the DLO that a hand grips; its way is off by a third of '
        'it; likewise', unit='m', minimum=0.0, maximum=0.1, of=OBSERVATION)
    calibrate: tuple[str, ...] = declared(
        (AUTO,), "names of the parameters to find; all others keep their fixed value; auto: the paper's four "
        '(flexibility, elasticity, friction, self_collision), and what the trials show besides: damping and '
        'internal_damping if goals were seen in motion; torsion, bending_friction and bending_slip if that '
        'was between two clamps; mass if it is unknown and forces on hands were measured',
        choices=(AUTO, *BY_NAME), of=SEARCH)
    own: tuple[str, ...] = declared(
        (), 'names of the parameters that differ from session to session, if several sessions of one DLO are '
        'calibrated together, e.g. friction on another table, or mass with another load; each session gets a '
        'value of its own; rest_shape: each session is a new grip by two clamps, and gets a rest shape of '
        'its own if cross-validation shows that',
        choices=(*(name for name in BY_NAME if name not in (*PART_NAMES, *STIFFNESS_KNOTS, *REST_STATE)),
                 OWN_SHAPE), of=SEARCH)
    sessions: str = declared(
        '', 'numbers of trials of each of several sessions of one DLO, in their order, e.g. 4 3; fit with '
        'several sessions sets it; empty: all trials are of one session', of=OBSERVATION)
    measured_by: str = declared('', 'who measured, for the passport of the result', of=OBSERVATION)
    parts: int = declared(
        0, 'number of parts of equal length, each with its own bending stiffness; 0: chosen by '
        'cross-validation, like the rest shape of a DLO in clamps that resists twist (search least_squares; '
        'others take one part); if flexibility is calibrated, so is the stiffness of every part; a higher '
        'part that calibrate names raises the number',
        minimum=0, maximum=MOST_PARTS, of=SEARCH)
    search: str = declared('least_squares', 'method that chooses the parameter sets to try',
                           choices=tuple(SEARCHES), of=SEARCH)
    evaluations: int = declared(
        0, "largest number of parameter sets to try (the paper's rounds); 0: 150, or 250 with search "
        'least_squares, or more if there are many parameters to find', minimum=0, maximum=1000000, of=SEARCH)
    seed: int = declared(1, 'random seed; the same seed gives the same result', minimum=0, maximum=2**31 - 1,
                         of=SEARCH)
    engine: str = declared(
        AUTO, 'simulation engine; auto: search with compiled and confirm the result with bullet',
        choices=(AUTO, CONFIRMING, 'compiled'), of=SEARCH)
    workers: int = declared(0, 'number of threads that simulate; 0: one per core', minimum=0, maximum=1024,
                            of=MACHINE)
    scheduler: str = declared(
        '', 'address of a Dask scheduler, e.g. tcp://host:8786; its workers then simulate, on any number of '
        'machines, and the option workers has no effect; empty: simulate on this machine', of=MACHINE)
    answer_limit: float = declared(
        60.0, 'time without an answer after which a process of PyBullet is replaced and its rollout is '
        'repeated', unit='s', minimum=1.0, maximum=86400.0, of=MACHINE)
    nodes: int = declared(DEFAULT_NODES, 'number of point masses of the simulated DLO', minimum=8,
                          maximum=1000, of=SEARCH)
    time_step: float = declared(DEFAULT_TIME_STEP, 'simulation time step', unit='s', minimum=0.0001,
                                maximum=0.02, of=SEARCH)
    stable_distance: float = declared(
        0.0005, 'the DLO is stable when all its nodes moved less than this within stable_time',
        unit='m', minimum=1e-6, maximum=0.1, of=SEARCH)
    stable_time: float = declared(0.25, 'time over which stable_distance is measured', unit='s',
                                  minimum=0.01, maximum=60.0, of=SEARCH)
    settle_limit: float = declared(10.0, 'simulated time after which waiting for a stable DLO ends',
                                   unit='s', minimum=0.1, maximum=600.0, of=SEARCH)
    grip_tolerance: float = declared(
        0.02, 'an action without annotated grip is refused if no point is this near to the hand',
        unit='m', minimum=0.0, maximum=10.0, of=OBSERVATION)
    length_tolerance: float = declared(
        50.0, 'a goal chain is refused if its length differs by more than this from the initial chain',
        unit='%', minimum=0.0, maximum=1000.0, of=OBSERVATION)
    release: bool = declared(
        True, 'whether a hand opens at its last waypoint; used if goal chains have no hand field',
        of=OBSERVATION)
    start_after_trials: int = declared(
        0, 'number of trials after which calibration starts by itself; 0: wait for ~/start', minimum=0,
        maximum=1000000, of=MACHINE)
    output_directory: str = declared('.', 'folder for the session and the result', of=MACHINE)
    record: bool = declared(True, 'whether to record the session', of=MACHINE)
    values: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = {name: FIXED_VALUES[name].checked(value) if name in FIXED_VALUES else
                 refuse_name(name, [option.name for option in Options.declarations()])
                 for name, value in self.values.items()}
        object.__setattr__(
            self, 'values', {name: given.get(name, d.default) for name, d in FIXED_VALUES.items()})
        if self.frame_pose and self.table_frame is None:
            Pose.of(self.frame_pose)  # refuses what is neither
        if not re.fullmatch('([1-9][0-9]{0,5}( [1-9][0-9]{0,5})*)?', self.sessions) or \
                len(self.trials_of_sessions) > MOST_SESSIONS:
            raise InputError('parameter sessions', repr(self.sessions[:40]),
                             f'the numbers of trials of at most {MOST_SESSIONS} sessions, e.g. 4 3',
                             'correct it')
        if AUTO in self.calibrate and self.calibrate != (AUTO,):
            raise InputError('parameter calibrate', ', '.join(self.calibrate), 'auto alone, or only names',
                             'leave auto out, and name every parameter to find')
        ParameterSpace(self._names)  # refuses an empty list and a name given twice

    @classmethod
    @cache
    def declarations(cls) -> tuple[Declaration, ...]:
        """Return the declaration of every option, in the order in which they are shown."""
        return (*super().declarations(), *FIXED_VALUES.values())

    @classmethod
    def _built(cls, options: Mapping[str, Any]) -> Self:
        return cls(**{name: value for name, value in options.items() if name not in FIXED_VALUES},
                   values={name: value for name, value in options.items() if name in FIXED_VALUES})

    def _value(self, name: str) -> Any:
        return self.values[name] if name in FIXED_VALUES else getattr(self, name)

    def check_together(self) -> None:
        """
        Check the options of the parameters together.

        :raises InputError: if they contradict each other.
        """
        self.space  # noqa: B018

    @property
    def table_top(self) -> float | None:
        """Height of the table top [m]; None: there is no table."""
        return self.table_height if self.table else None

    @property
    def table_frame(self) -> str | None:
        """The name of the table's frame, if `frame_pose` is a name."""
        return self.frame_pose if re.fullmatch(r'[A-Za-z_][\w/]*', self.frame_pose) else None

    @property
    def pose(self) -> Pose | None:
        """
        The pose of the chains' frame in the table's frame; None: they are the same.

        :raises InputError: if only its name is known.
        """
        if self.table_frame is not None:
            raise InputError('frame_pose', f'the name {self.table_frame!r}', f'the numbers {NUMBERS}',
                             'give the pose; only the node looks up the transform of a frame')
        return Pose.of(self.frame_pose) if self.frame_pose else None

    @property
    def space(self) -> ParameterSpace:
        """
        The parameters to find, and the fixed values of the others.

        Where `calibrate` is auto, these are the paper's parameters, which it always finds; `choice.choose`
        adds those that the trials show.
        """
        named = ParameterSpace(self._names)
        smooth = any(name in self._names or self.values[name] != BY_NAME[name].default
                     for name in STIFFNESS_KNOTS)
        values = {name: value for name, value in self.values.items() if smooth or name not in STIFFNESS_KNOTS}
        bent = {name: value for name, value in self.values.items()
                if name in REST_STATE and value != BY_NAME[name].default}
        hands = {name: BY_NAME[name].value(getattr(self, name)) for name in HANDS if getattr(self, name)}
        space = ParameterSpace(self._names, {**values, **hands}, self.mass).divided(
            max(self.parts, named.parts)).shaped(named.knots or ParameterSpace(self._names, bent).knots)
        return replace(space, free=(*space.free, *(
            own_name(name, session) for name in self.own if name != OWN_SHAPE
            for session in range(2, len(self.trials_of_sessions) + 1))))

    @property
    def trials_of_sessions(self) -> tuple[int, ...]:
        """The numbers of trials of each session; empty: all are of one."""
        return tuple(map(int, self.sessions.split()))

    @property
    def _names(self) -> tuple[str, ...]:
        return PAPER_PARAMETERS if self.calibrate == (AUTO,) else self.calibrate


FIXED_VALUES: Mapping[str, Declaration] = {
    p.name: Declaration(
        p.name, p.default, f'{p.description}: {p.quantity} from {measured(p.at_zero, p.unit)} (at 0) to '
        f'{measured(p.at_hundred, p.unit)} (at 100), {"linear" if p.linear else "logarithmic"}; '
        'used if it is not calibrated',
        of=SEARCH, minimum=0.0, maximum=SCALE)
    for p in PARAMETERS if p.name not in ('mass', *HANDS)}  # these are options in kg, s and m


def names_of(kind: str) -> tuple[str, ...]:
    """Return the names of the options of a kind: OBSERVATION, SEARCH or MACHINE."""
    return tuple(declaration.name for declaration in Options.declarations() if declaration.of == kind)


@dataclass(frozen=True)
class FileOptions:
    """
    Options of a file, by name.

    :param values: those to use, without the machine's; `scene` is an absolute path.
    :param warnings: what the user should know about the file, e.g. which options are left out.
    :param refusal: why the scene is left out; without its scene, nothing can be simulated.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    refusal: InputError | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'values', MappingProxyType(dict(self.values)))

    def options(self, given: Mapping[str, Any] = MappingProxyType({})) -> Options:
        """
        Return all options: those of the file, overridden by `given` ones; else the defaults.

        :raises InputError: if the file names a scene that cannot be used, and `given` has none.
        """
        if self.refusal is not None and 'scene' not in given:
            raise self.refusal
        return Options.of({**self.values, **given})


def file_options(given: Mapping[str, Any], folder: Path | None) -> FileOptions:
    """
    Return the options of a file that this version accepts and that a file may set.

    :param given: as in the file, of any names, types and values.
    :param folder: of the file; None: the options came in a message or as bytes.
    """
    usable: dict[str, Any] = {}
    warnings = []
    for name, value in given.items():
        try:
            Options.of({name: value})
        except InputError as error:
            warnings.append(f'a recorded option is left out: {error}')
        else:
            usable[name] = value
    defaults = Options().flat()
    ignored = [name for name in names_of(MACHINE) if usable.pop(name, defaults[name]) != defaults[name]]
    if ignored:
        warnings.append(f'recorded options are left out, as only the command line or the node may set them: '
                        f'{", ".join(ignored)}')
    try:
        if usable.get('scene'):
            usable['scene'] = str(_scene(usable['scene'], folder))
    except InputError as error:
        del usable['scene']
        return FileOptions(usable, (*warnings, str(error)), error)
    return FileOptions(usable, tuple(warnings))


def recordable(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that a file records: all except those of the machines."""
    machine = names_of(MACHINE)
    return {name: value for name, value in options.items() if name not in machine}


def _scene(name: str, folder: Path | None) -> Path:
    """
    Return the path of a scene that a file names, if it lies in the folder of the file.

    If the recorded path leads elsewhere, a scene of the same name in that folder is used.

    :raises InputError: if the folder has no such regular file, whatever lies elsewhere.
    """
    if folder is not None:
        try:
            home = folder.resolve()
            for path in ((home / name).resolve(), (home / Path(name).name).resolve()):
                if path.is_relative_to(home) and path.is_file():
                    return path
        except (OSError, ValueError, RuntimeError):  # a name that no file can have, or a loop of links
            pass
    raise InputError(f'recorded scene {name}', 'no such file in the folder of the recording',
                     'a scene that lies there' if folder is not None else 'no scene',
                     'copy the scene to that folder, or give it with --scene')
