# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The package's exceptions: one base class, unusable inputs, and simulations that fail.

Their texts may quote what came from outside: they are one line, and safe to show in a terminal.  Only what
came from outside is shortened, never a sentence of the package.
"""

from __future__ import annotations

from difflib import get_close_matches
import re
from typing import Iterable

DEFECT = 'this is a defect of dlo_calibration, please report it'  # ends the report of an unexpected error
LONGEST = 100  # characters of a quoted text that came from outside
LONGEST_WORD = 300  # characters without a blank, such as a path
LONGEST_TEXT = 2000  # characters of a text: more than any of ours

#: Control characters (C0, DEL, C1), separators of lines, bidirectional overrides, and halves of surrogates.
_UNSAFE = re.compile('[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]')
#: Texts in quotes; an apostrophe in or after a word is none.
_QUOTED = re.compile(r"""(?<!\w)(?:'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")(?!\w)""")
_LONG_WORD = re.compile(rf'\S{{{LONGEST_WORD + 1},}}')


def printable(text: str) -> str:
    r"""
    Return a text as one line that is safe to show: a terminal or viewer obeys nothing in it.

    White space becomes blanks; other control characters, bidirectional overrides and lone surrogates are
    escaped, e.g. as ``\x1b`` or ``\u202e``.
    """
    return _UNSAFE.sub(_escaped, text)


def shortened(text: str, most: int = LONGEST) -> str:
    """Return a text with at most `most` characters; if it is longer, an ellipsis replaces its middle."""
    if len(text) <= most:
        return text
    tail = (most - 1) // 2
    return f'{text[:most - 1 - tail]}…{text[len(text) - tail:]}'


def safe_line(text: str) -> str:
    """
    Return a text as one line that is safe to show.

    Quoted texts and long words, which come from outside, are shortened; sentences are not, unless there are
    more of them than the package ever writes.
    """
    # First and last, as escaping megabytes would take long, and makes a text longer.
    text = printable(shortened(text, 2 * LONGEST_TEXT))
    text = _QUOTED.sub(lambda match: shortened(match[0]), text)
    return shortened(_LONG_WORD.sub(lambda match: shortened(match[0], LONGEST_WORD), text), LONGEST_TEXT)


def _escaped(match: re.Match[str]) -> str:
    character = match[0]
    if character.isspace():
        return ' '
    return f'\\x{ord(character):02x}' if ord(character) < 256 else f'\\u{ord(character):04x}'


class DloCalibrationError(Exception):
    """Base of every error that this package raises on purpose; its text is one safe line."""

    def __str__(self) -> str:
        return safe_line(super().__str__())


class InputError(DloCalibrationError):
    """
    An input that cannot be used.

    The message, ``thing: came; expected ...; remedy``, always answers the same four questions, so that its
    reader can act without opening the code.  Each answer is one safe line.

    :param thing: which input, e.g. ``goal_chain stamped 12.5 s``.
    :param came: what is wrong with it: a noun, e.g. ``two hands that grip point 3``, or a statement.
    :param expected: what would have been accepted.
    :param remedy: what the user can do.
    """

    def __init__(self, thing: str, came: str, expected: str, remedy: str) -> None:
        self.thing, self.came, self.expected, self.remedy = parts = tuple(
            map(safe_line, (thing, came, expected, remedy)))
        super().__init__(*parts)

    def __str__(self) -> str:
        return f'{self.thing}: {self.came}; expected {self.expected}; {self.remedy}'


class SimulationError(DloCalibrationError):
    """A trial that an engine cannot simulate, or a rollout that diverged."""


def one_line(error: BaseException) -> str:
    """Return an error's text as one line, which begins with the type of an error that is not ours."""
    kind = '' if isinstance(error, DloCalibrationError) else type(error).__name__
    return ' '.join(': '.join(filter(None, (kind, str(error)))).split())


def one_of(valid: Iterable[str], name: str) -> str:
    """Say which names are expected: all valid ones, or the most similar to `name` if there are many."""
    valid = list(valid)
    if len(valid) <= 8:  # they fit into an error
        return f'one of {", ".join(valid)}'
    near = get_close_matches(shortened(name), valid, n=3, cutoff=0)
    return f'one of {", ".join(near)} or {len(valid) - len(near)} others'


def suggestion(name: str, valid: Iterable[str], otherwise: str) -> str:
    """Return the remedy for an unknown name: the most similar valid one; if none is similar, `otherwise`."""
    plain = {_plain(candidate): candidate for candidate in valid}
    near = get_close_matches(_plain(shortened(name)), plain, n=1)
    return f'did you mean {plain[near[0]]}?' if near else otherwise


def _plain(name: str) -> str:
    return name.lower().strip('-').replace('-', '_')


def unwritable(path: object, error: OSError, kind: str = 'file') -> InputError:
    """Return the error for a file, or another `kind` of path, that cannot be written."""
    return InputError(f'{kind} {path}', error.strerror or str(error), 'a place that can be written to',
                      'choose another place')
