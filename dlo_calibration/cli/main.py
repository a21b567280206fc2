# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The command line `dlo-calibration`: calibrates from recorded sessions, without ROS."""

from __future__ import annotations

import argparse
from importlib import import_module
from signal import SIGINT
import sys
from typing import Any, NoReturn, Sequence, TYPE_CHECKING

from dlo_calibration.cli.output import print_message
from dlo_calibration.errors import DloCalibrationError, InputError, one_of, printable, suggestion
from dlo_calibration.signals import exit_code

if TYPE_CHECKING:
    from dlo_calibration.calibration.engines import SimulatorFactory

PROGRAM = 'dlo-calibration'  # as installed; begins each line of an error
#: What each verb does, for the help.
VERBS = {
    'capture': 'open the page in which photographs become trials, and calibrate there',
    'trace': "find a DLO's middle line in a photograph from a few rough clicks, and with a scale its chain",
    'track': 'follow a DLO and the hands that move it through a film, and cut it into a session of trials',
    'fit': 'find the parameters that explain a session best',
    'validate': 'simulate a session with the parameters of a result, without fitting',
    'check': 'tell whether a session still shows the DLO of a result, and which parameter has changed if not',
    'simulate': 'predict what a calibrated DLO does in the actions of a session or a request',
    'plan': 'find actions that bring a calibrated DLO from one configuration to another',
    'export': 'write a calibrated DLO as a file for another simulator',
    'info': 'show what a session contains',
    'plot': 'draw a picture of each trial, as measured and as simulated with a result',
    'experiment': "repeat the paper's experiment, which measures how consistent and how valid the found "
                  'parameters are',
}


def module_of(verb: str) -> Any:
    """Import the module of a verb; it has `add_arguments`, and `act`, which returns the exit code."""
    return import_module(f'dlo_calibration.cli.{verb}')


def main(args: Sequence[str] | None = None, make_simulator: SimulatorFactory | None = None) -> int:
    """
    Execute a command line.

    :param args: command line without the program's name; None: that of the process.
    :param make_simulator: makes the engine; None: as the options say.
    :returns: exit code: 0; 2, with one line on stderr, if an input cannot be used or something cannot
        be written; 130 or 143 if SIGINT (Ctrl-C) or SIGTERM arrived before there was anything to
        report, or before an experiment was complete.
    """
    try:
        words = sys.argv[1:] if args is None else args
        if not words:
            raise InputError('verb', 'none', f'one of {", ".join(VERBS)}', f'see {PROGRAM} --help')
        if words[0] not in VERBS and not words[0].startswith('-'):
            raise InputError('verb', repr(words[0]), one_of(VERBS, words[0]),
                             suggestion(words[0], VERBS, f'see {PROGRAM} --help'))
        chosen = _parser(words).parse_args(words)
        from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
        from dlo_calibration.cli.arguments import options_without_effect

        for flag in options_without_effect(chosen):
            print_message(f'{flag}: has no effect on {words[0]}')
        return int(chosen.act(chosen, make_simulator or make_chosen_simulator))
    except DloCalibrationError as error:
        print_message(f'{PROGRAM}: {" ".join(str(error).split())}')
        return 2
    except KeyboardInterrupt as interrupt:
        print_message(f'{PROGRAM}: interrupted')
        return int(interrupt.args[0]) if interrupt.args else exit_code(SIGINT)
    except BrokenPipeError:  # the reader of the pipe, such as `head`, has ended
        sys.stderr.close()
        return 0


class _Help(argparse.HelpFormatter):
    """Help whose usage lists only the verb's own arguments; the options of a calibration follow below."""

    def add_usage(self, usage: Any, actions: Any, groups: Any, prefix: Any = None) -> None:
        """Leave out the options."""
        from dlo_calibration.cli.arguments import PREFIX

        super().add_usage(
            usage, [action for action in actions if not action.dest.startswith(PREFIX)], groups, prefix)


class _Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line, and names the flag that was probably meant."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse a flag that this verb does not have; flags may be typed with underscores."""
        if self.prog == PROGRAM:
            return super().parse_known_args(args, namespace)
        from dlo_calibration.cli.arguments import dashed

        chosen, rest = super().parse_known_args(dashed(args), namespace)
        strange = [word.partition('=')[0] for word in rest if word.startswith('--')]
        if strange:
            hint = suggestion(strange[0], self._option_string_actions, '')
            self.error(f'unrecognized arguments: {" ".join(rest)}{"; " if hint else ""}{hint}')
        return chosen, rest

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'{self.prog}: {printable(" ".join(message.split()))}; see {self.prog} --help\n')


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser; only a verb among the words is loaded and gets its arguments."""
    parser = _Parser(prog=PROGRAM, allow_abbrev=False, description=(
        'Find the physical parameters of a rope, cable, wire or hose from recorded manipulations.'))
    verbs = parser.add_subparsers(required=True, metavar='VERB')
    for name, text in VERBS.items():
        added = verbs.add_parser(name, help=text, description=text, allow_abbrev=False, formatter_class=_Help)
        if name in words:
            verb = module_of(name)
            added.set_defaults(act=verb.act)
            verb.add_arguments(added)
    return parser
