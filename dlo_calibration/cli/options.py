# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Options as flags: adds a flag for each declared option, and reads those that a command line gives."""

from __future__ import annotations

import argparse
from typing import Any, Sequence

from dlo_calibration.calibration.options import Declaration, declarations

PREFIX = 'option_'  # tells options from the other attributes of a parsed command line


def add_options(parser: argparse.ArgumentParser, without: Sequence[str] = ()) -> None:
    """Add a flag for every option except those in `without`; flags that are not given have no attribute."""
    group = parser.add_argument_group('options of the calibrator (default: as the session was recorded)')
    for declaration in (one for one in declarations() if one.name not in without):
        names = dict.fromkeys((f'--{declaration.name.replace("_", "-")}', f'--{declaration.name}'))
        group.add_argument(*names, dest=f'{PREFIX}{declaration.name}', default=argparse.SUPPRESS,
                           **_flag(declaration))


def given_options(chosen: argparse.Namespace) -> dict[str, Any]:
    """Return the options that a command line gives, by name."""
    given = {name.removeprefix(PREFIX): value for name, value in vars(chosen).items()
             if name.startswith(PREFIX)}
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
        return {'nargs': '+', 'metavar': 'NAME', 'help': f'{text} (several words, or one with commas)'}
    return {'type': kind, 'metavar': kind.__name__.upper() if not declaration.choices else
            '|'.join(declaration.choices), 'help': text}
