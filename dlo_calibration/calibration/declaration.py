# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Declaration of an option: its default, meaning, unit and range; and the base of classes of options."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Mapping, NoReturn, Self, Sequence

from dlo_calibration.errors import InputError, meant, one_of

#: What an option describes: how trials were observed; what is searched and simulated; the user's machines:
#: computer and robot. Files never set those of the machines (`file_options`). The mass belongs to the
#: search, though it was measured: `validate` takes it from the result, as all physical values are in
#: proportion to it.
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
            for one in value if kind is tuple else (value,):
                if one not in self.choices:
                    raise InputError(what, f'{one!r}', one_of(self.choices, one),
                                     meant(one, self.choices, 'choose one of them'))
        low, high = self.minimum, self.maximum
        if kind in (int, float) and not (
                (low is None or value >= low) and (high is None or value <= high)):
            raise InputError(what, f'{value:g} {self.unit}'.rstrip(),
                             f'{"" if low is None else f"{low:g}"} to {"" if high is None else f"{high:g}"}'
                             f' {self.unit}'.rstrip(), 'choose a value in that range')
        return value


def declared(default: Any, description: str, of: str, **rest: Any) -> Any:
    """Return the field of an option; the arguments are those of its `Declaration`, but for the name."""
    return field(default=default, metadata={'description': description, 'of': of, **rest})


@dataclass(frozen=True)
class DeclaredOptions:
    """
    Base of the classes of options: frozen dataclasses whose fields `declared` makes.

    Command-line flags, ROS parameters and parameter files are generated from their declarations.
    """

    def __post_init__(self) -> None:
        for one in self._declared_fields():
            object.__setattr__(self, one.name, one.checked(getattr(self, one.name)))

    @classmethod
    def _declared_fields(cls) -> tuple[Declaration, ...]:
        return tuple(Declaration(one.name, one.default, **one.metadata)
                     for one in fields(cls) if one.metadata)

    @classmethod
    def declarations(cls) -> tuple[Declaration, ...]:
        """Return the declaration of every option, in the order in which they are shown."""
        return cls._declared_fields()

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """
        Build from a flat mapping of option names to values.

        :raises InputError: for an unknown name, a wrong type, or a value out of range.
        """
        known = [one.name for one in cls.declarations()]
        for name in options:
            if name not in known:
                refuse_name(name, known)
        return cls._built(options)

    @classmethod
    def _built(cls, options: Mapping[str, Any]) -> Self:
        return cls(**options)

    def flat(self) -> dict[str, Any]:
        """Return all options by name, as `of` takes them; tuples as lists."""
        values = {one.name: self._value(one.name) for one in self.declarations()}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def _value(self, name: str) -> Any:
        return getattr(self, name)

    def check_together(self) -> None:
        """
        Check several options together.

        :raises InputError: if they contradict each other.
        """


def refuse_name(name: str, known: Sequence[str]) -> NoReturn:
    """Raise the InputError for an option with an unknown name."""
    raise InputError('parameter', repr(name), f'{one_of(known, name)} in doc/messages.md',
                     meant(name, known, 'correct the name'))
