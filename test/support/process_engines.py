# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Simulators for a process of their own: one that hangs, and what makes each of them there."""

import ctypes
from functools import partial
import os

from toy_simulator import Deadly, ToySimulator

from dlo_calibration.evaluation import ProcessSimulator
from dlo_calibration.model.parameters import BY_NAME


class Hanging(ToySimulator):
    """It hangs in native code, which holds Python's lock, where flexibility is more than 90 (0..100)."""

    def simulate(self, trial, physical):
        """Hang, or do what the toy does."""
        if BY_NAME['flexibility'].value(physical['flexibility']) > 90:
            ctypes.PyDLL(None).sleep(1000)
        return super().simulate(trial, physical)


class AlwaysHanging(ToySimulator):
    """It hangs in each simulation."""

    def simulate(self, trial, physical):
        """Hang."""
        ctypes.PyDLL(None).sleep(1000)


class Dying(ToySimulator):
    """Its process dies in each simulation."""

    def simulate(self, trial, physical):
        """Die."""
        os._exit(3)


class Slow(ToySimulator):
    """It advances all the time, for two seconds."""

    def simulate(self, trial, physical):
        """Take many short steps."""
        for _ in range(20):
            ctypes.PyDLL(None).usleep(100_000)
        return super().simulate(trial, physical)


class Telling(ToySimulator):
    """It tells of its process, in an error."""

    def simulate(self, trial, physical):
        """Tell."""
        raise RuntimeError(f'{os.getpid()} {os.nice(0)}')


def in_process(kind, *args, limit=60.0, content='scene peg.urdf'):
    """Return a simulator of some kind in a process of its own."""
    return ProcessSimulator(kind.name, partial(kind, *args), content, limit)


__all__ = ['AlwaysHanging', 'Deadly', 'Dying', 'Hanging', 'Slow', 'Telling', 'in_process']
