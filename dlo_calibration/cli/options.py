# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Options as flags: adds a flag for each declared option, and reads those that a command line gives."""

from __future__ import annotations

import argparse
from typing import Any, Sequence

from dlo_calibration.calibration.declaration import Declaration, DeclaredOptions
from dlo_calibration.calibration.options import Options

PREFIX = 'option_'  # tells options from the other attributes of a parsed command line


def add_options(parser: argparse.ArgumentParser, without: Sequence[str] = (),
                kind: type[DeclaredOptions] = Options,
                title: str = 'options of the calibrator (default: as the session was recorded)') -> None:
    """
    Add a flag for every option except those in `without`; flags that are not given have no attribute.

    :param kind: the class of the options; of two classes, no option may have the same name.
    :param title: of the group of flags in the help.
    """
    group = parser.add_argument_group(title)
    for declaration in (one for one in kind.declarations() if one.name not in without):
        names = dict.fromkeys((f'--{declaration.name.replace("_", "-")}', f'--{declaration.name}'))
        group.add_argument(*names, dest=f'{PREFIX}{declaration.name}', default=argparse.SUPPRESS,
                           **_flag(declaration))


def given_options(chosen: argparse.Namespace, kind: type[DeclaredOptions] = Options) -> dict[str, Any]:
    """Return the options of a class that a command line gives, by name."""
    known = {f'{PREFIX}{declaration.name}': declaration.name for declaration in kind.declarations()}
    given = {known[name]: value for name, value in vars(chosen).items() if name in known}
    return {name: [word for text in value for word in text.split(',') if word] if isinstance(value, list)
            else value for name, value in given.items()}


def _flag(declaration: Declaration) -> dict[str, Any]:
    """Return the keyword arguments of `add_argument` for an option."""
    default = ' '.join(declaration.default) if isinstance(declaration.default, tuple) else declaration.default
    unit = f' [{declaration.unit}]' if declaration.unit else ''
    text = f'{declaration.description}{unit}; default {default}'.replace('%', '%%')
    kind = type(declaration.default)
    if kind is bool:
        return {'action': argparse.BooleanOptionalAction, 'help': text}
    if kind is tuple:
        return {'nargs': '+', 'metavar': 'NAME' if declaration.choices else 'TEXT',
                'help': f'{text} (several words, or one with commas)'}
    return {'type': kind, 'metavar': kind.__name__.upper() if not declaration.choices else
            '|'.join(declaration.choices), 'help': text}
