# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A ROS graph of a test's own: a DDS domain in which nobody else is."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import itertools
import os
import socket

import pytest

# Each worker of pytest-xdist takes its own share of the DDS domains.  Above 101 the ports of a domain fall
# into the range that Linux gives to any program.
# https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Domain-ID.html
WORKER = os.environ.get('PYTEST_XDIST_WORKER', '')  # gw0, gw1, ...; none without pytest-xdist
DOMAINS = range(1 + int(WORKER.removeprefix('gw') or 0), 102,
                int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', 1)))
FIRST_PORT, PORTS_PER_DOMAIN, UNICAST = 7400, 250, 10

_turns = itertools.count(os.getpid())  # tests of two checkouts at the same time begin in different domains


def _unused(domain: int) -> bool:
    """Tell whether no participant on this machine listens in a DDS domain."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', FIRST_PORT + PORTS_PER_DOMAIN * domain + UNICAST))
        except OSError:
            return False
    return True


@contextmanager
def ros_graph(folder) -> Iterator[Mapping[str, str]]:
    """
    Give a ROS graph of its own, on this machine alone, which logs into `folder`.

    It holds for this process, and for a child that gets the returned environment.
    """
    domains = (DOMAINS[turn % len(DOMAINS)] for turn in itertools.islice(_turns, len(DOMAINS)))
    domain = next(filter(_unused, domains))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('ROS_LOG_DIR', str(folder / 'ros_log'))
        patch.delenv('ROS_STATIC_PEERS', raising=False)
        yield dict(os.environ)
