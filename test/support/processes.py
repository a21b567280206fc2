# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Processes of this machine, from /proc: `ps` is not everywhere, and cuts long lines."""

from pathlib import Path


def _with(place, number):
    """Return the command lines of living processes whose status has a number at a place, by id."""
    commands = {}
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            fields = (folder / 'stat').read_text().rpartition(')')[2].split()
            if int(fields[place]) == number and fields[0] != 'Z':
                commands[int(folder.name)] = (folder / 'cmdline').read_bytes().replace(b'\0', b' ').decode()
        except (FileNotFoundError, ProcessLookupError):  # it ended meanwhile
            pass
    return commands


def children(parent):
    """Return the command lines of a process's children, by id."""
    return _with(1, parent)


def simulating(parent):
    """List the ids of the processes that simulate for a process."""
    return [pid for pid, text in children(parent).items() if 'process_simulator' in text]


def of_session(leader):
    """Return the command lines of the living processes that were started in a process's session, by id."""
    return _with(3, leader)
