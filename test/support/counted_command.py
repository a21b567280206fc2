# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The command line, counted: `counted_command.py FILE VERB ...` appends a letter to FILE for whatever happens.

S: a simulation begins, in whatever process; E: the user is shown an evaluation.
"""

import functools
import os
import sys

from toy_simulator import ToySimulator
from without_drawings import leave_out_drawings, leave_out_slices

from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.cli import main as cli
from dlo_calibration.report.terminal import SearchBar


def note(path, letter):
    """Append a letter, at once."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.write(file, letter)
    os.close(file)


class CountedEngine:
    """An engine whose simulations are counted in a file."""

    def __init__(self, engine, path):
        self.name, self.engine, self.path = engine.name, engine, path

    def simulate(self, trial, physical):
        """Count, and simulate."""
        note(self.path, b'S')
        return self.engine.simulate(trial, physical)

    def refined(self):
        """Return the refined engine, which counts, too."""
        finer = self.engine.refined()
        return None if finer is None else CountedEngine(finer, self.path)

    def close(self):
        """Close the engine."""
        self.engine.close()


def make(path, options):
    """Return the engine of the options; the toy in place of `compiled` alone, as it loads faster."""
    engine = ToySimulator(0.01) if options.engine == 'compiled' else make_simulator(options)
    return CountedEngine(engine, path)


def main():
    """Execute the verb."""
    path, take = sys.argv[1], SearchBar.take

    def take_and_note(bar, evaluation):
        note(path, b'E')
        take(bar, evaluation)

    SearchBar.take = take_and_note
    leave_out_drawings()
    leave_out_slices()
    return cli.main(sys.argv[2:], functools.partial(make, path))


if __name__ == '__main__':
    import counted_command  # a process that simulates does not know what the main module defines

    sys.exit(counted_command.main())
