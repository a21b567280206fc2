# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A session behind a graph that is no ROS graph."""

from collections import defaultdict
import time

from toy_messages import MINUTE

from dlo_calibration.files.record import encode, typestore
from dlo_calibration.messages.codec import bag_types, INPUT_TYPES, OUTPUT_TYPES
from dlo_calibration.ros.calibrator_options import CalibratorOptions
from dlo_calibration.ros.session import CalibrationSession

PATIENCE = 60.0  # s
TYPES = bag_types()


def values(status):
    return {pair.key: pair.value for pair in status.values}


def whole(result):
    return values(next(status for status in result.status if status.name == 'calibration'))


class ToyNode:
    """
    A graph in which whatever is published is heard at once; `elapsed` [s] lets time pass.

    A subclass makes the `session`.

    :param inputs: name of each topic -> its type; `outputs` likewise.
    """

    def __init__(self, name, inputs, outputs):
        self.name, self.inputs, self.outputs = name, inputs, outputs
        self.elapsed = 0.0
        self.heard, self.logged, self.waiting = defaultdict(list), defaultdict(list), []
        self.info, self.warn, self.error = (self.logged[level].append for level in ('info', 'warn', 'error'))

    def clock(self):
        return time.monotonic() + self.elapsed

    def stamp(self):
        return MINUTE

    def topic(self, name):
        return f'/{self.name}/{name}'

    def decode(self, kind, octets):
        return typestore().deserialize_cdr(octets, self.inputs[kind])

    def encode(self, name, message):
        return encode(message, self.outputs[name])

    def publish(self, name, octets):
        self.heard[name].append(typestore().deserialize_cdr(octets, self.outputs[name]))

    def hear_waiting(self):
        pairs, self.waiting = self.waiting, []
        self.send(pairs)

    def send(self, pairs):
        for kind, message in pairs:
            self.session.hear(kind, encode(message, self.inputs[kind]))
        self.session.tick()

    def until(self, condition):
        begun = time.monotonic()
        while not condition():
            assert time.monotonic() - begun < PATIENCE, self.status
            self.session.tick()
            time.sleep(0.002)

    @property
    def status(self):
        return values(self.heard['status'][-1].status[0])


class ToyGraph(ToyNode):
    """The graph of a calibration session."""

    def __init__(self, folder, make, status_period=0.0, **options):
        super().__init__('calibrator', INPUT_TYPES, OUTPUT_TYPES)
        self.set = {'output_directory': str(folder), 'workers': 1, 'evaluations': 30, **options}
        self.session = CalibrationSession(self, TYPES, make, self.clock)
        self.session.status_period = status_period

    def options(self):
        return CalibratorOptions.of({**CalibratorOptions().flat(), **self.set})

    def calibrated(self):
        """Start, and return the result."""
        before = len(self.heard['result'])
        done, answer = self.session.request('start')
        assert done, answer
        self.until(lambda: self.status['state'] != 'calibrating')
        assert self.status['state'] == 'done', self.status
        assert len(self.heard['result']) == before + 1
        return self.heard['result'][-1]
