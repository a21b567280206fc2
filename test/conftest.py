# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Fixtures that several test modules share."""

from collections.abc import Mapping
import itertools
import os
import socket

import pytest
from wire import SOURCES

# Above 101 the ports of a domain fall into the range that Linux gives to any program.
# https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Domain-ID.html
DOMAINS = 101
FIRST_PORT, PORTS_PER_DOMAIN, UNICAST = 7400, 250, 10

_turns = itertools.count(os.getpid())


def _unused(domain: int) -> bool:
    """Tell whether no participant on this machine listens in a DDS domain."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', FIRST_PORT + PORTS_PER_DOMAIN * domain + UNICAST))
        except OSError:
            return False
    return True


@pytest.fixture
def ros_environment(monkeypatch: pytest.MonkeyPatch, tmp_path) -> Mapping[str, str]:
    """
    Give a ROS graph of the test's own, on this machine alone.

    It holds for the test's process, and for a child that gets the returned
    environment.
    """
    domains = (1 + turn % DOMAINS for turn in itertools.islice(_turns, DOMAINS))
    domain = next(filter(_unused, domains))
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'ros_log'))
    monkeypatch.delenv('ROS_STATIC_PEERS', raising=False)
    return dict(os.environ)


@pytest.fixture(params=SOURCES)
def types(request):
    """Give the message classes of either source."""
    return SOURCES[request.param]()
