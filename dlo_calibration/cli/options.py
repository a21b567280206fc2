# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Options as flags: adds a flag for each declared option, and reads those that a command line gives."""

from __future__ import annotations

import argparse
import re
from typing import Any, Sequence

from dlo_calibration.calibration.declaration import Declaration, DeclaredOptions
from dlo_calibration.calibration.options import Options

PREFIX = 'option_'  # tells options from the other attributes of a parsed command line
_NUMBERED = re.compile(r'[xy]?\d+$')  # tells options of one kind apart: of a part, a knot or a hand
_FLAG = re.compile('^--[a-z0-9_]+(?==|$)')


def add_options(parser: argparse.ArgumentParser, without: Sequence[str] = (),
                kind: type[DeclaredOptions] = Options,
                title: str = 'options of the calibrator (default: as the session was recorded)') -> None:
    """
    Add a flag for every option except those in `without`; flags that are not given have no attribute.

    :param kind: the class of the options; of two classes, no option may have the same name.
    :param title: of the group of flags in the help.
    """
    group = parser.add_argument_group(title)
    wanted = [one for one in kind.declarations() if one.name not in without]
    for declaration in wanted:
        family = [_dashed(one.name) for one in wanted
                  if _NUMBERED.sub('', one.name) == _NUMBERED.sub('', declaration.name)]
        group.add_argument(_dashed(declaration.name), dest=f'{PREFIX}{declaration.name}',
                           default=argparse.SUPPRESS, **_flag(declaration, family))


def dashed(words: Sequence[str]) -> list[str]:
    """Return a command line whose flags have dashes; a user may type an option's name with underscores."""
    return [_FLAG.sub(lambda flag: flag[0].replace('_', '-'), word) for word in words]


def given_options(chosen: argparse.Namespace, kind: type[DeclaredOptions] = Options) -> dict[str, Any]:
    """Return the options of a class that a command line gives, by name."""
    known = {f'{PREFIX}{declaration.name}': declaration.name for declaration in kind.declarations()}
    given = {known[name]: value for name, value in vars(chosen).items() if name in known}
    return {name: [word for text in value for word in text.split(',') if word] if isinstance(value, list)
            else value for name, value in given.items()}


def _dashed(name: str) -> str:
    return f'--{name.replace("_", "-")}'


def _flag(declaration: Declaration, family: Sequence[str]) -> dict[str, Any]:
    """
    Return the keyword arguments of `add_argument` for an option.

    :param family: flags that differ only in a number, its own among them; of many, the help has the first.
    """
    default = ' '.join(declaration.default) if isinstance(declaration.default, tuple) else declaration.default
    unit = f' [{declaration.unit}]' if declaration.unit else ''
    text = f'{declaration.description}{unit}' + f'; default {default}' * (default != '')
    many = len(family) > 2
    text = (text + f'; the same for the others, up to {family[-1]}' * many).replace('%', '%%')
    if many and family[0] != _dashed(declaration.name):
        text = argparse.SUPPRESS
    kind = type(declaration.default)
    if kind is bool:
        return {'action': argparse.BooleanOptionalAction, 'help': text}
    if kind is tuple:
        return {'nargs': '+', 'metavar': 'NAME' if declaration.choices else 'TEXT',
                'help': f'{text} (several words, or one with commas)'}
    return {'type': kind, 'metavar': kind.__name__.upper() if not declaration.choices else
            '|'.join(declaration.choices), 'help': text}
