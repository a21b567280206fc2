# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The command line `dlo-calibration`: calibrates from recorded sessions, without ROS."""

from __future__ import annotations

import argparse
from multiprocessing import parent_process
from signal import SIGINT
import sys
from typing import Any, NoReturn, Sequence

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.cli import (
    capture,
    experiment,
    export,
    fit,
    info,
    plan,
    plot,
    simulate,
    trace,
    validate,
    warm_up,
)
from dlo_calibration.cli.options import dashed, PREFIX
from dlo_calibration.cli.output import tell
from dlo_calibration.errors import DloCalibrationError, InputError, meant, one_of, printable
from dlo_calibration.signals import exit_code
from dlo_calibration.simulation.kernel_cache import (
    compile_kernels,
    is_compiled,
    KERNELS,
    SIMULATION,
    TOGETHER,
)
from dlo_calibration.simulation.protocol import Simulator

PROGRAM = 'dlo-calibration'  # as installed; begins each line of an error
#: A verb's module has a `TEXT` for the help, `add_arguments`, and `act`, which returns the exit code.
VERBS = {'capture': capture, 'trace': trace, 'fit': fit, 'validate': validate, 'simulate': simulate,
         'plan': plan, 'export': export, 'info': info, 'plot': plot, 'experiment': experiment,
         'warm-up': warm_up}


def make_told(options: Options) -> Simulator:
    """Return the simulator that `options` name; tell before its kernels are compiled, which takes long."""
    if parent_process() is None:
        for module in (SIMULATION, TOGETHER):
            if not is_compiled(module):
                tell(f'compiling the {KERNELS[module]} for this machine, once, about half a minute')
                compile_kernels(module)
    return make_chosen_simulator(options)


def main(args: Sequence[str] | None = None, make_simulator: SimulatorFactory = make_told) -> int:
    """
    Execute a command line.

    :param args: command line without the program's name; None: that of the process.
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
                             meant(words[0], VERBS, f'see {PROGRAM} --help'))
        chosen = _parser(words).parse_args(dashed(words))
        code: int = chosen.act(chosen, make_simulator)
        return code
    except DloCalibrationError as error:
        tell(f'{PROGRAM}: {" ".join(str(error).split())}')
        return 2
    except KeyboardInterrupt as interrupt:
        tell(f'{PROGRAM}: interrupted')
        return int(interrupt.args[0]) if interrupt.args else exit_code(SIGINT)
    except BrokenPipeError:  # the reader of the pipe, such as `head`, has ended
        sys.stderr.close()
        return 0


class _Help(argparse.HelpFormatter):
    """Help whose first lines show what is a verb's own; the options of a calibration are listed below."""

    def add_usage(self, usage: Any, actions: Any, groups: Any, prefix: Any = None) -> None:
        """Leave the options out."""
        super().add_usage(usage, [one for one in actions if not one.dest.startswith(PREFIX)], groups, prefix)


class _Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line, and names the flag that was probably meant."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse a flag that this verb does not have."""
        chosen, rest = super().parse_known_args(args, namespace)
        strange = [word.partition('=')[0] for word in rest if word.startswith('--')]
        if strange and self.prog != PROGRAM:
            hint = meant(strange[0], self._option_string_actions, '')
            self.error(f'unrecognized arguments: {" ".join(rest)}{"; " if hint else ""}{hint}')
        return chosen, rest

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'{self.prog}: {printable(" ".join(message.split()))}; see {self.prog} --help\n')


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser; only a verb that is among the words has its arguments, as there are hundreds."""
    parser = _Parser(prog=PROGRAM, allow_abbrev=False, description=(
        'Find the physical parameters of a rope, cable, wire or hose from recorded manipulations.'))
    verbs = parser.add_subparsers(required=True, metavar='VERB')
    for name, verb in VERBS.items():
        added = verbs.add_parser(name, help=verb.TEXT, description=verb.TEXT, allow_abbrev=False,
                                formatter_class=_Help)
        added.set_defaults(act=verb.act)
        if name in words:
            verb.add_arguments(added)
    return parser
