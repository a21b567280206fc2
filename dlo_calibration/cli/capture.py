# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `capture`: the page in which a person turns photographs into trials and calibrates."""

from __future__ import annotations

import argparse
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
import ipaddress
import os
from pathlib import Path
import sys
import threading
from typing import Any, Callable, Iterator, TYPE_CHECKING
import webbrowser

from dlo_calibration.calibration.declaration import MACHINE, OBSERVATION
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.file_options import recordable
from dlo_calibration.calibration.options import names_of, Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.cli.options import add_options, given_options, PREFIX
from dlo_calibration.cli.output import standard_output, tell
from dlo_calibration.cli.result_files import INPUTS, keep_input, write_files
from dlo_calibration.cli.source import read_source, Source
from dlo_calibration.cli.unfinished import Unfinished
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.log import EvaluationLog
from dlo_calibration.model.trial import Trial
from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import Attempts, make_folder

if TYPE_CHECKING:
    from dlo_calibration.capture.connections import Graph

FOLDER = Path('dlo-capture')
PAPERS = ('a4', 'letter')
#: Options that the page has fields for, that belong to recordings, or that only the node has.
_NOT_HERE = ('mass', 'start_after_trials', 'output_directory', 'record')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('folder', metavar='FOLDER', type=Path, nargs='?', default=FOLDER,
                        help=f'what is done on the page is kept there; default {FOLDER}')
    parser.add_argument('--port', type=int, default=0, help='of the server; default: one that is free')
    parser.add_argument('--host', metavar='ADDRESS', default='127.0.0.1',
                        help='address on which the server listens; default 127.0.0.1: only this machine')
    parser.add_argument('--no-browser', action='store_true',
                        help='do not open the page, only print its address')
    parser.add_argument('--print-board', metavar='FILE.pdf', type=Path,
                        help='write the board that is laid beside the DLO, to be printed, and end')
    parser.add_argument('--paper', choices=PAPERS, default=PAPERS[0], help='of the board; default a4')
    add_options(parser, without=(*names_of(OBSERVATION), *_NOT_HERE), title='options of the calibrator')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    if chosen.print_board is not None:
        return _print_board(chosen.print_board, chosen.paper)
    with StopFlag() as stop:
        serve_page(chosen, make_simulator, stop, partial(_say, chosen))
    return 0


def serve_page(chosen: argparse.Namespace, make_simulator: SimulatorFactory,
               should_stop: Callable[[], bool], ready: Callable[[str], None]) -> None:
    """
    Serve the page until `should_stop` returns true.

    :param ready: called with its address.
    """
    Options.of({**Options().flat(), **given_options(chosen)})  # a bad value is told at once
    if not 0 <= chosen.port <= 65535:
        raise InputError('option port', str(chosen.port), '0 to 65535', 'choose one in that range')
    with ExitStack() as stack:
        with _no_output_to_choose('name another folder'):
            make_folder(chosen.folder)
        from dlo_calibration.capture.connections import Connections
        from dlo_calibration.capture.project import Project
        from dlo_calibration.capture.server import serve

        project = Project(chosen.folder)
        stack.callback(project.close)
        for problem in project.problems:
            tell(problem)
        connections = Connections(
            begin=partial(_Calibration.begin, chosen, make_simulator),
            sentences=_sentences, graph=_graph(), options=_recorded(chosen), make_simulator=make_simulator)
        serve(project, connections, host=chosen.host, port=chosen.port, ready=ready,
              should_stop=should_stop)
    tell(f'everything is kept in {chosen.folder}')


@dataclass
class _Calibration:
    """A calibration that the page began; its folder is as `fit --output` would leave it."""

    trials: tuple[Trial, ...]
    options: Options
    log: EvaluationLog | None
    source: Source
    unfinished: Unfinished
    folder: Path
    make_simulator: SimulatorFactory

    @classmethod
    def begin(cls, chosen: argparse.Namespace, make_simulator: SimulatorFactory, folder: Path, session: Path,
              tell: Callable[[str], None]) -> _Calibration:
        """Begin; see `connections.Begin`."""
        machine = names_of(MACHINE)
        flags = {f'{PREFIX}{name}': value for name, value in given_options(chosen).items() if name in machine}
        words = argparse.Namespace(session=session, namespace=None, **flags)
        source = read_source(words, tell).require_trials()
        unfinished = Unfinished(folder, INPUTS)
        try:
            log = unfinished.begin(source, None, lambda path: keep_input(path, source), tell)
        except InputError:  # another calibration was interrupted, and the person wants this one now
            unfinished.remove()
            unfinished = Unfinished(folder, INPUTS)
            log = unfinished.begin(source, None, lambda path: keep_input(path, source), tell)
        return cls(source.trials, source.options, log, source, unfinished, folder, make_simulator)

    def write(self, result: CalibrationResult, should_stop: Callable[[], bool]) -> Attempts:
        """Write the files of the result."""
        return write_files(self.folder, self.source, result, self.make_simulator, should_stop)

    def close(self, finished: bool) -> None:
        """Remove what was kept, if the calibration is finished."""
        with self.unfinished:
            if finished:
                self.unfinished.remove()


def _recorded(chosen: argparse.Namespace) -> dict[str, Any]:
    """Return the options of the command line that a session records."""
    return recordable(given_options(chosen))


def _sentences(result: CalibrationResult) -> list[str]:
    from dlo_calibration.report.sentences import sentences

    return [*([result.choice.words] if result.choice and result.choice.words else []), *sentences(result)]


def _graph() -> Graph | None:
    """Return the ROS graph, if there is ROS here."""
    if find_spec('rclpy') is None:
        return None
    from dlo_calibration.ros.capture_graph import CaptureGraph

    return CaptureGraph()


def _say(chosen: argparse.Namespace, address: str) -> None:
    """Tell where the page is, and open it."""
    with standard_output() as stream:
        stream.write(f'The page is at {address}\nCtrl-C ends it; everything is kept in {chosen.folder}.\n')
    if not _is_loopback(chosen.host):
        tell(f'warning: --host {chosen.host}: everybody who can reach this machine and knows the address can '
             'see the photographs, change the project and calibrate; nothing is encrypted')
    # Without a display, the browser that Python finds would take over this terminal.
    if not chosen.no_browser and (sys.platform != 'linux' or any(
            os.environ.get(name) for name in ('DISPLAY', 'WAYLAND_DISPLAY', 'BROWSER'))):
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()


def _is_loopback(host: str) -> bool:
    try:
        return host == 'localhost' or ipaddress.ip_address(host).is_loopback
    except ValueError:  # another name
        return False


@contextmanager
def _no_output_to_choose(remedy: str) -> Iterator[None]:
    """Give what cannot be written in this block its own remedy: the verb has no --output."""
    try:
        yield
    except InputError as error:
        raise InputError(error.thing, error.came, error.expected, remedy) from error


def _print_board(path: Path, paper: str) -> int:
    """Write the board."""
    from dlo_calibration.capture.board_sheet import write_board

    with _no_output_to_choose('name another file'):
        write_board(path, paper)
    tell(f'{path}: print it at 100 % (not "fit to page") on {paper}, and check its ruler line')
    return 0
