# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The server of the capture page, in this process with the toy or in another one; a client; photographs."""

import argparse
from contextlib import contextmanager
import json
import os
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request

import cv2
import numpy as np
import pytest
import toy_command
from toy_simulator import ToySimulator

from dlo_calibration.cli import capture
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.page import information

PATIENCE = 60.0  # s
SIZE = 400, 300  # px: small, so that tracing takes no time
PER_METRE = 625.0  # px, seen straight from above
DIAMETER = 0.012  # m
CORNERS = ((10.0, 10.0), (390.0, 10.0), (390.0, 290.0), (10.0, 290.0))
ALONG = np.linspace(0, 1, 200)
START = np.column_stack([37 + 325 * ALONG, 150 + 25 * np.sin(3 * ALONG)])  # px
GOAL = START + np.column_stack([0 * ALONG, 75 * np.exp(-((ALONG - 1) / 0.35)**2)])


def table(pixel):
    """Return where on the table, x y [m], a pixel is."""
    return [(pixel[0] - 10.0) / PER_METRE, (290.0 - pixel[1]) / PER_METRE]


SCALE = {'kind': 'points', 'points': [{'pixel': list(corner), 'table': table(corner)} for corner in CORNERS]}


def drawn(line, suffix='.png'):
    """Return the file of a photograph of a dark DLO along `line`, (n, 2) [px], on a light table."""
    pixels = np.full((SIZE[1], SIZE[0], 3), (206, 212, 214), np.uint8)
    if line is not None:
        cv2.polylines(pixels, [np.round(line * 16).astype(np.int32)], False, (40, 60, 150),
                      round(DIAMETER * PER_METRE), cv2.LINE_AA, 4)
    pixels = cv2.GaussianBlur(pixels, (0, 0), 1.0).astype(float)
    pixels += np.random.default_rng(1).normal(0, 2, pixels.shape)
    return cv2.imencode(suffix, np.clip(pixels, 0, 255).astype(np.uint8))[1].tobytes()


def clicks(line):
    """Return a few pixels along a line, some pixels off."""
    return [[float(u) + 2, float(v) - 2] for u, v in line[[3, 70, 130, -4]]]


class Page:
    """What the page asks of the server."""

    def __init__(self, address):
        self.address = address

    def ask(self, method, path, content=None, headers=None):
        """Return status, headers and content of an answer."""
        headers = dict(headers or {})
        if isinstance(content, dict):
            content = json.dumps(content).encode()
            headers.setdefault('Content-Type', 'application/json')
        url = urllib.parse.urljoin(self.address, path)
        request = urllib.request.Request(url, content, headers, method=method)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                return answer.status, answer.headers, answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.headers, error.read()

    def get(self, path):
        """Return the content of what is there."""
        status, _, content = self.ask('GET', path)
        assert status == 200, content
        return content

    def refused(self, method, path, content=None, headers=None):
        """Return status and sentence of a refusal."""
        status, _, answer = self.ask(method, path, content, headers)
        assert status >= 400
        sentence = json.loads(answer)['error']
        assert sentence and '\n' not in sentence and 'Traceback' not in sentence
        return status, sentence

    def state(self):
        """Return the state."""
        return json.loads(self.get('api/state'))

    def done(self, method, path, content=None, headers=None):
        """Do something that succeeds; return the JSON that is answered."""
        status, _, answer = self.ask(method, path, content, headers)
        assert status == 200, answer
        return json.loads(answer)

    def change(self, edit):
        """Let `edit` change the document; return the state."""
        state = self.state()
        edit(state['document'])
        return self.done('PUT', 'api/document', {key: state[key] for key in ('revision', 'document')})

    def add(self, octets, name='photograph.png'):
        """Add a photograph; return its id."""
        return self.done('POST', 'api/photographs', octets, {'X-Name': urllib.parse.quote(name)})['id']

    def until(self, ready, what='it'):
        """Wait until `ready` accepts the state; return it."""
        begun = time.monotonic()
        while not ready(state := self.state()):
            assert time.monotonic() - begun < PATIENCE, f'{what} never came: {state["calibration"]}'
            time.sleep(0.05)
        return state


def described(document):
    """Enter scale, clicks and hands for two photographs of a trial."""
    document['dlo']['diameter'] = DIAMETER
    for photograph, line in zip(document['photographs'], (START, GOAL), strict=True):
        photograph.update(scale=SCALE, clicks=clicks(line))
    document['trials'][0]['steps'] = [{'kind': 'drag', 'fraction': 1.0}]


def whole_trial(page):
    """Make a trial from two photographs; return the state."""
    page.add(drawn(START), 'start.png')
    page.add(drawn(GOAL), 'goal.png')
    return page.change(described)


class ToyInformation:
    """
    An appraiser that knows at once what each trial adds, and remembers what it was asked.

    :cvar advice: what it says of what to do next; None: nothing.
    """

    advice = None

    def __init__(self, make_simulator=None):
        self.started, self.stopped, self.alive, self.waiting, self._done = [], 0, False, [], []

    def start(self, trials, options, then=None):
        done, self._done = self._done, [trial.name for trial in trials]
        self.started.append(self._done)
        names = options.space.free
        self.waiting += [TrialInformation(name, names, np.full(len(names), 0.3), np.full(len(names), 0.06))
                         for name in self.started[-1] if name not in done]
        self.waiting += [self.advice] * (then is not None and self.advice is not None)

    def stop(self):
        self.stopped += 1
        self.waiting, self._done = [], []  # as what was known of the trials is deleted, too

    def join(self, timeout=None):
        return not self.alive

    def waiting_events(self):
        reported, self.waiting = self.waiting, []
        yield from reported


@contextmanager
def served(folder, *words, simulator=ToySimulator, appraising=False):
    """
    Give the page of a folder, served by this process.

    :param appraising: tell what trials add; a process does that, which takes seconds to begin.
    """
    parser = argparse.ArgumentParser()
    capture.add_arguments(parser)
    chosen = parser.parse_args([str(folder), '--no-browser', '--workers', '1', *map(str, words)])
    addresses, failures, ending = [], [], threading.Event()

    def serve():
        try:
            capture.serve_page(chosen, lambda _: simulator(), ending.is_set, addresses.append)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=serve)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(information, 'QUIET', 0.1 if appraising else float('inf'))
        thread.start()
        try:
            begun = time.monotonic()
            while not addresses:
                assert not failures and time.monotonic() - begun < PATIENCE, failures
                time.sleep(0.02)
            yield Page(addresses[0])
        finally:
            ending.set()
            thread.join(PATIENCE)
    assert not failures and not thread.is_alive()


@contextmanager
def page_process(folder, *words, program=(toy_command.__file__, '0.01')):
    """Give the page of a folder, and the process that serves it; by default, with the toy."""
    process = subprocess.Popen(
        [sys.executable, *program, 'capture', str(folder), '--no-browser', '--workers', '1',
         *map(str, words)], env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        assert line, process.stderr.read()
        yield Page(line.split()[-1]), process
    finally:
        process.kill()
        process.communicate()
