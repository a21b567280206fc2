# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `capture`: the page in which a person turns photographs into trials and calibrates."""

from __future__ import annotations

import argparse
from contextlib import closing
from functools import partial
from importlib.util import find_spec
import ipaddress
import os
from pathlib import Path
import sys
import threading
from typing import Callable
import webbrowser

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import names_of, OBSERVATION, Options
from dlo_calibration.cli.arguments import add_options, given_options
from dlo_calibration.cli.output import print_message, standard_output
from dlo_calibration.errors import InputError
from dlo_calibration.signals import StopFlag
from dlo_calibration.writing import make_folder

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
    add_options(parser, {*Options().flat()} - {*names_of(OBSERVATION), *_NOT_HERE},
                title='options of the calibrator')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    if chosen.print_board is not None:
        from dlo_calibration.vision.board import write_board

        write_board(chosen.print_board, chosen.paper)
        print_message(f'{chosen.print_board}: print it at 100 % (not "fit to page") on {chosen.paper}, and '
                      'check its ruler line')
        return 0
    with StopFlag() as stop:
        serve_page(chosen, make_simulator, stop, partial(_announce, chosen))
    return 0


def serve_page(chosen: argparse.Namespace, make_simulator: SimulatorFactory,
               should_stop: Callable[[], bool], ready: Callable[[str], None]) -> None:
    """
    Serve the page until `should_stop` returns true.

    :param ready: called with its address.
    """
    Options.of(given_options(chosen))  # a bad value is refused before the page opens
    if not 0 <= chosen.port <= 65535:
        raise InputError('option port', str(chosen.port), '0 to 65535', 'choose one in that range')
    make_folder(chosen.folder)
    from dlo_calibration.capture.project import Project
    from dlo_calibration.page.server import serve
    from dlo_calibration.page.studio import Studio
    from dlo_calibration.ros.capture_graph import CaptureGraph

    graph = CaptureGraph() if find_spec('rclpy') else None
    with closing(Project(chosen.folder)) as project:
        for warning in project.warnings:
            print_message(warning)
        serve(Studio(project, make_simulator, given_options(chosen), graph), host=chosen.host,
              port=chosen.port, ready=ready, should_stop=should_stop)
    print_message(f'everything is kept in {chosen.folder}')


def _announce(chosen: argparse.Namespace, address: str) -> None:
    """Print the address of the page, and open it in a browser."""
    with standard_output() as stream:
        stream.write(f'The page is at {address}\nCtrl-C ends it; everything is kept in {chosen.folder}.\n')
    if not _is_loopback(chosen.host):
        print_message(
            f'warning: --host {chosen.host}: everybody who can reach this machine and knows the address can '
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
