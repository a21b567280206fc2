# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The toy in a process that dies: `mortal.py SIMULATIONS VERB ...` is killed (-9) at that simulation.

As a module: `Mortal`, an engine that counts its simulations.
"""

import os
import signal
import sys

from toy_simulator import ToySimulator


class Mortal(ToySimulator):
    """
    A toy that counts its simulations, and dies at one of them.

    :param name: of the engine.
    :param last: number of the simulation at which, and from which on, `die` is called.
    :param counted: has one item for each simulation; engines may share it.
    """

    def __init__(self, name='toy', last=None, die=None, counted=None):
        super().__init__(fail_below=20.0)
        self.name, self.last, self.die = name, last, die
        self.counted = [] if counted is None else counted

    @property
    def count(self):
        """Number of simulations so far."""
        return len(self.counted)

    def simulate(self, trial, physical):
        """Count, and do what the toy does; it trembles, so that the residuals need an explanation."""
        if self.last is not None and len(self.counted) >= self.last - 1:
            self.die()
        self.counted.append(trial.name)
        return super().simulate(trial, {**physical, 'friction': physical['friction'] * 1.1})


def main():
    """Execute a verb with a toy that kills this process."""
    from drawings import leave_out_drawings, leave_out_slices

    from dlo_calibration.cli.main import main as execute

    leave_out_drawings()
    leave_out_slices()
    toy = Mortal(last=int(sys.argv[1]), die=lambda: os.kill(os.getpid(), signal.SIGKILL))
    return execute(sys.argv[2:], lambda _: toy)


if __name__ == '__main__':
    sys.exit(main())
