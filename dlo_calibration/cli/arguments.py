# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The arguments that several verbs share: the input, and a flag for each declared option."""

from __future__ import annotations

import argparse
from pathlib import Path
import re
from typing import Any, Collection, Sequence

from dlo_calibration.calibration.options import Declaration, DeclaredOptions, Options
from dlo_calibration.errors import InputError, one_of, suggestion
from dlo_calibration.files.result import Description, read_result
from dlo_calibration.messages.codec import INPUT_TYPES
from dlo_calibration.workspace.source import is_request, Selection

PREFIX = 'option_'  # of the attributes of a parsed command line that are options
WITHOUT_EFFECT = f'{PREFIX}without_effect_'  # of those that change nothing in a verb
_NUMBERED = re.compile(r'[xy]?\d+$')  # distinguishes the options of parts, knots or hands
_FLAG = re.compile('^--[a-z0-9_]+(?==|$)')


def add_source(parser: argparse.ArgumentParser, several: bool = False) -> None:
    """
    Add the arguments that name a session or a request, and the options to use on it.

    :param several: whether there may be any number of them, also none.
    """
    parser.add_argument('session', metavar='SESSION', type=Path, nargs='*' if several else None,
                        help='an MCAP file, the folder of a rosbag2 recording, or an XML request'
                        + '; several of the same DLO are calibrated together' * several)
    add_without(parser)
    add_common_arguments(parser)
    add_options(parser)


def add_without(parser: argparse.ArgumentParser) -> None:
    """Add the flag that leaves trials out."""
    parser.add_argument('--without', metavar='K', action='append', default=[],
                        help='leave out the trial with this number, or several: 2,5')


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of every verb that reads a session."""
    parser.add_argument('--namespace', help='namespace of the topics, if a session has several')
    parser.add_argument('--remap', metavar='TOPIC:=NAME', action='append', default=[],
                        help=f'read a topic with another name as {one_of(INPUT_TYPES, "")}, '
                        'e.g. /trackdlo/results_pc:=goal_chain; may be repeated')
    parser.add_argument('--json', action='store_true', help='print one JSON document')


def selected(chosen: argparse.Namespace, path: Path | None = None) -> Selection:
    """
    Return what a command line selects of a session or a request.

    :param path: of the session or the request; None: the one on the command line.
    :raises InputError: if a topic or the number of a trial is malformed.
    """
    return Selection(chosen.session if path is None else path, given_options(chosen), chosen.namespace,
                     _remap(chosen.remap), _without(getattr(chosen, 'without', ())))


def read_result_file(chosen: argparse.Namespace) -> Description:
    """
    Read the RESULT.xml of a command line.

    :raises InputError: if it cannot be read; the remedy names a session given in its place.
    """
    try:
        return read_result(chosen.result)
    except InputError as error:
        if is_request(chosen.session) and not is_request(chosen.result):
            raise InputError(error.thing, error.came, error.expected,
                             'name RESULT.xml and SESSION in the other order') from error
        raise


def _without(texts: Sequence[str]) -> tuple[int, ...]:
    """Return the numbers of the trials to leave out."""
    words = [word for text in texts for word in text.split(',')]
    for word in words:
        if not word.isdecimal() or len(word) > 9:
            raise InputError('--without', repr(word), 'numbers of trials, e.g. 2,5',
                             'see them with dlo-calibration info')
    return tuple(sorted(set(map(int, words))))


def _remap(texts: Sequence[str]) -> dict[str, str]:
    """Return the remapped topics, each with the input topic that it replaces."""
    remap: dict[str, str] = {}
    for text in texts:
        topic, sign, kind = text.partition(':=')
        kind, topic = kind.removeprefix('~/'), f'/{topic.lstrip("/")}'
        if not sign or kind not in INPUT_TYPES:
            raise InputError('--remap', repr(text), f'TOPIC:=NAME, where NAME is {one_of(INPUT_TYPES, kind)}',
                             suggestion(kind, INPUT_TYPES, 'write it like /trackdlo/results_pc:=goal_chain'))
        if topic in remap or kind in remap.values():
            raise InputError('--remap', f'{topic if topic in remap else kind} twice', 'each once',
                             'leave one of them out')
        remap[topic] = kind
    return remap


def add_options(parser: argparse.ArgumentParser, only: Collection[str] | None = None,
                kind: type[DeclaredOptions] = Options,
                title: str = 'options of the calibrator (default: as the session was recorded)') -> None:
    """
    Add a flag for every option of a class; flags that are not given have no attribute.

    :param only: names of the options that have an effect. The flags of the others are not in the help, and
        `options_without_effect` returns them.
    :param kind: the class of the options; names of options differ between classes.
    :param title: of the group of flags in the help.
    """
    group = parser.add_argument_group(title)
    wanted = [option for option in kind.declarations() if only is None or option.name in only]
    for declaration in wanted:
        family = [_dashed(option.name) for option in wanted
                  if _NUMBERED.sub('', option.name) == _NUMBERED.sub('', declaration.name)]
        group.add_argument(_dashed(declaration.name), dest=f'{PREFIX}{declaration.name}',
                           default=argparse.SUPPRESS, **_flag(declaration, family))
    for declaration in kind.declarations():
        flag = _dashed(declaration.name)
        if declaration not in wanted and flag not in parser._option_string_actions:
            group.add_argument(flag, dest=f'{WITHOUT_EFFECT}{declaration.name}', default=argparse.SUPPRESS,
                               **{**_flag(declaration, [flag]), 'help': argparse.SUPPRESS})


def options_without_effect(chosen: argparse.Namespace) -> list[str]:
    """Return the flags of a command line that are options, but change nothing in its verb."""
    return [_dashed(name.removeprefix(WITHOUT_EFFECT)) for name in vars(chosen)
            if name.startswith(WITHOUT_EFFECT)]


def dashed(words: Sequence[str]) -> list[str]:
    """Replace underscores in flags by dashes; a user may type an option as ROS names it."""
    return [_FLAG.sub(lambda flag: flag[0].replace('_', '-'), word) for word in words]


def given_options(chosen: argparse.Namespace, kind: type[DeclaredOptions] = Options) -> dict[str, Any]:
    """Return the options of a class that a command line gives, by name."""
    names = {f'{PREFIX}{declaration.name}': declaration.name for declaration in kind.declarations()}
    given = {names[name]: value for name, value in vars(chosen).items() if name in names}
    return {name: [word for text in value for word in text.split(',') if word] if isinstance(value, list)
            else value for name, value in given.items()}


def _dashed(name: str) -> str:
    return f'--{name.replace("_", "-")}'


def _flag(declaration: Declaration, family: Sequence[str]) -> dict[str, Any]:
    """
    Return the keyword arguments of `add_argument` for an option.

    :param family: flags that differ only in a number; the help shows the first of many.
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
