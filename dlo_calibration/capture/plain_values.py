# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Plain values: reads the objects, lists and numbers of a JSON document, and says where one is wrong."""

from __future__ import annotations

from dataclasses import dataclass
import math
import re
from typing import Any, Iterator, Sequence

from dlo_calibration.errors import InputError, meant

REMEDY = 'correct the document, or take the action back'


@dataclass(frozen=True)
class Entry:
    """
    One value of a document, of any type, and where it is.

    :param where: e.g. ``trial 2, step 1, height``.
    """

    where: str
    value: Any

    @property
    def given(self) -> bool:
        """Whether there is a value, and not null."""
        return self.value is not None

    def refused(self, came: str, expected: str) -> InputError:
        """Return the error that refuses it."""
        return InputError(self.where, came, expected, REMEDY)

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
                             meant(str(self.value)[:200], choices, REMEDY))
        return self.value

    def entries(self, least: int, most: int) -> Iterator[Entry]:
        """Yield the values of a list; the first is number 1."""
        if not isinstance(self.value, (list, tuple)) or not least <= len(self.value) <= most:
            raise self.refused(_shown(self.value), f'a list of {least} to {most}')
        for number, one in enumerate(self.value, start=1):
            yield Entry(f'{self.where} {number}', one)

    def numbers(self, count: int, low: float, high: float) -> tuple[float, ...]:
        """Return a list of so many numbers in a range."""
        return tuple(one.number(low, high) for one in self.entries(count, count))

    def values(self, *known: str) -> Values:
        """Return an object; with names, it may have no others."""
        if not isinstance(self.value, dict):
            raise self.refused(_shown(self.value), 'an object with names and values')
        values = Values(self.where, self.value)
        if known:
            values.only(*known)
        return values


@dataclass(frozen=True)
class Values:
    """An object of a document, and where it is."""

    where: str
    content: dict[str, Any]

    def only(self, *known: str) -> None:
        """Refuse names other than these."""
        unknown = next((name for name in self.content if name not in known), None)
        if unknown is not None:
            raise InputError(self.where or 'document', f'an unknown field {_shown(unknown)}',
                             f'fields of {", ".join(known)}', meant(unknown, known, REMEDY))

    def entry(self, name: str, default: Any = None) -> Entry:
        """Return a value by its name; the default where there is none."""
        return Entry(self._place(name), self.content.get(name, default))

    def each(self, name: str, one: str, most: int) -> list[Entry]:
        """Return the values of a list by its name, each called `one` and its number."""
        entries = self.entry(name, []).entries(0, most)
        return [Entry(self._place(f'{one} {number}'), entry.value)
                for number, entry in enumerate(entries, start=1)]

    def _place(self, name: str) -> str:
        return f'{self.where}, {name}' if self.where else name


def _shown(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: 'nothing', True: 'true', False: 'false'}[value]
    if isinstance(value, (dict, list, tuple)):
        return f'{"an object" if isinstance(value, dict) else "a list"} of {len(value)}'
    if isinstance(value, int) and value.bit_length() > 100:
        return 'a huge number'
    return repr(value[:200] if isinstance(value, str) else value)
