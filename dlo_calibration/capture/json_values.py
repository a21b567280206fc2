# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
JSON values: the checked objects, lists and numbers of a document; an error names its place.

Validation libraries name places and remedies for programmers; here each error is a sentence for the person.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, MISSING
import json
import math
import re
from typing import Any, Callable, Iterator, Mapping, Sequence, TypeVar

from dlo_calibration.errors import InputError, suggestion

REMEDY = 'correct the document, or undo the change'

Record = TypeVar('Record')


@dataclass(frozen=True)
class JsonValue:
    """
    One value of a document, of any type, and where it is.

    :param where: e.g. ``trial 2, step 1, height``; empty: the whole document.
    """

    where: str
    value: Any

    @property
    def given(self) -> bool:
        """Whether there is a value, and not null."""
        return self.value is not None

    def refused(self, came: str, expected: str) -> InputError:
        """Return the error that refuses it."""
        return InputError(self.where or 'document', came, expected, REMEDY)

    def number(self, low: float, high: float) -> float:
        """Return a finite number in a range."""
        if isinstance(self.value, bool) or not isinstance(self.value, (int, float)):
            raise self.refused(_shown(self.value), f'a number from {low:g} to {high:g}')
        if not low <= self.value <= high:  # also refuses nan, and compares huge integers exactly
            raise self.refused(_shown(self.value), f'{low:g}' if low == high else
                               f'a number from {low:g} to {high:g}')
        return float(self.value)

    def whole(self, low: int, high: int) -> int:
        """Return a whole number in a range."""
        number = self.number(low, high)
        if number != math.floor(number):
            raise self.refused(_shown(self.value), 'a whole number')
        return int(number)

    def truth(self) -> bool:
        """Return true or false."""
        if not isinstance(self.value, bool):
            raise self.refused(_shown(self.value), 'true or false')
        return self.value

    def text(self, most: int) -> str:
        """Return a text."""
        if not isinstance(self.value, str) or len(self.value) > most:
            raise self.refused(_shown(self.value), f'a text of at most {most} characters')
        return self.value

    def word(self, most: int) -> str:
        """Return a text without blanks and control characters."""
        if not re.fullmatch(r'[^\s\x00-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]+', self.text(most)):
            raise self.refused(_shown(self.value), 'a name without blanks')
        return str(self.value)

    def choice(self, choices: Sequence[str]) -> str:
        """Return one of some texts."""
        if not isinstance(self.value, str) or self.value not in choices:
            raise InputError(self.where, _shown(self.value), f'one of {", ".join(choices)}',
                             suggestion(str(self.value)[:200], choices, REMEDY))
        return self.value

    def entries(self, least: int, most: int, noun: str = '') -> Iterator[JsonValue]:
        """Yield the values of a list; their places have the noun and the number, from 1."""
        place = f'{self.where} ' if not noun else self.where[:self.where.rfind(' ') + 1] + f'{noun} '
        if not isinstance(self.value, (list, tuple)) or not least <= len(self.value) <= most:
            raise self.refused(_shown(self.value), f'a list of {least} to {most}')
        for number, value in enumerate(self.value, start=1):
            yield JsonValue(f'{place}{number}', value)

    def numbers(self, count: int, low: float, high: float) -> tuple[float, ...]:
        """Return a list of `count` numbers in a range."""
        return tuple(entry.number(low, high) for entry in self.entries(count, count))

    def only(self, *names: str) -> None:
        """Refuse an object with other names than these."""
        unknown = next((name for name in self._content if name not in names), None)
        if unknown is not None:
            raise InputError(self.where or 'document', f'an unknown field {_shown(unknown)}',
                             f'fields of {", ".join(names)}', suggestion(unknown, names, REMEDY))

    def entry(self, name: str, default: Any = None) -> JsonValue:
        """Return a value of an object by its name; the default where there is none."""
        return JsonValue(f'{self.where}, {name}' if self.where else name, self._content.get(name, default))

    def record(self, kind: type[Record]) -> Record:
        """Return an object as a dataclass, whose fields are declared by `entry_field`."""
        declared = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
        self.only(*declared)
        values = {name: field.metadata['read'](
            self.entry(name, None if field.default is MISSING else plain(field.default)))
            for name, field in declared.items()}
        return kind(**{name: value for name, value in values.items() if declared[name].init})

    @property
    def _content(self) -> dict[str, Any]:
        if not isinstance(self.value, dict):
            raise self.refused(_shown(self.value), 'an object with names and values')
        return self.value


def entry_field(read: Callable[[JsonValue], Any], default: Any = MISSING, init: bool = True) -> Any:
    """
    Declare a field of a dataclass that is an entry of a document.

    :param read: returns its value, checked.
    """
    return field(default=default, init=init, metadata={'read': read})


def parsed(octets: bytes) -> Any:
    """
    Return the values in a JSON file, without nan and infinity.

    :raises ValueError: or RecursionError, if it is damaged.
    """
    return json.loads(octets, parse_constant=_refuse_constant)


def _refuse_constant(text: str) -> Any:
    raise ValueError(f'{text} is no number')


def _shown(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: 'nothing', True: 'true', False: 'false'}[value]
    if isinstance(value, (dict, list, tuple)):
        return f'{"an object" if isinstance(value, dict) else "a list"} of {len(value)}'
    if isinstance(value, int) and value.bit_length() > 100:
        return 'a huge number'
    return repr(value[:200] if isinstance(value, str) else value)


def plain(value: Any) -> Any:
    """Return dataclasses and mappings as objects, and tuples as lists, of plain values."""
    if hasattr(value, 'json_entries'):
        return plain(value.json_entries)
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items()}
    return [plain(entry) for entry in value] if isinstance(value, tuple) else value
