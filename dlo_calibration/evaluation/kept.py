# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""kept_simulator(): the simulator that a worker keeps from call to call."""

from __future__ import annotations

import pickle
import threading

from dlo_calibration.simulation.protocol import Simulator


def packed_simulator(simulator: Simulator) -> bytes:
    """Return what is sent to workers."""
    return pickle.dumps(simulator, pickle.HIGHEST_PROTOCOL)


class _WorkerThread(threading.local):
    packed = b''
    simulator: Simulator


_worker_thread = _WorkerThread()


def kept_simulator(packed: bytes) -> Simulator:
    """
    Return the simulator of this thread that was sent with its last call, or a new one if another is sent.

    A new one does not know the trials, and PyBullet needs a twentieth of a second to begin with it.
    """
    if _worker_thread.packed != packed:
        if _worker_thread.packed:
            _worker_thread.simulator.close()
        _worker_thread.simulator = pickle.loads(packed)  # noqa: S301  # sent by the parent process
        _worker_thread.packed = packed
    return _worker_thread.simulator
