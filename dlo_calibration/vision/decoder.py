# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The process that decodes a film: the main function of a child, which `film` starts.

Films of strangers can attack a decoder.  This process has limits on memory, open files and silence, writes no
file, and opens nothing but the film.  It imports little, so that it starts soon.

It writes `HEADER`, then answers each `REQUEST`, a period of time [s], with frames: `FRAME`, the time [s], and
the pixels (h, w, 3) RGB.  After the last one the time is not a number.
"""

import faulthandler
import math
import os
import resource
import struct
import sys
from typing import Any, BinaryIO, NoReturn

#: width and height [px], frame rate [1/s], duration [s]
HEADER = struct.Struct('<iidd')
REQUEST = struct.Struct('<dd')
FRAME = struct.Struct('<d')
#: exit codes: what was wrong with the film
UNREADABLE, UNDECODABLE, TOO_LARGE, CHANGED = range(3, 7)
HANGING = 1  # exit code of `faulthandler`
SILENCE = 20.0  # s without a frame after which the process ends
MEMORY = 3 * 2**30  # octets of address space, of which most is never used
MAXIMUM_PIXELS = 4096 * 4096
#: what FFmpeg may read: not the formats that name other files or addresses
FORMATS = 'mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi'
OPTIONS = f'protocol_whitelist;file|format_whitelist;{FORMATS}'
BEFORE = 0.5  # s before the wanted time that a search aims at
NEAR = 2.0  # s that are decoded rather than skipped


def main(path: str) -> NoReturn:
    """Decode a film until the parent closes the connection."""
    for limit, value in ((resource.RLIMIT_AS, MEMORY), (resource.RLIMIT_FSIZE, 0), (resource.RLIMIT_CORE, 0),
                         (resource.RLIMIT_NOFILE, 64)):
        resource.setrlimit(limit, (value, value))
    os.environ.update(OPENCV_FFMPEG_CAPTURE_OPTIONS=OPTIONS, OPENCV_LOG_LEVEL='OFF',
                      OPENCV_FFMPEG_LOGLEVEL='-8')
    answers, requests = sys.stdout.buffer, sys.stdin.buffer
    decoder = _Decoder(path)
    try:
        answers.write(HEADER.pack(*decoder.size, decoder.frame_rate, decoder.duration))
        answers.flush()
        while len(request := requests.read(REQUEST.size)) == REQUEST.size:
            begin, end = REQUEST.unpack(request)
            decoder.answer(begin, end, answers)
    except OSError:  # the parent has closed the connection, or has ended
        pass
    os._exit(0)


class _Decoder:
    """A film that is open."""

    def __init__(self, path: str) -> None:
        import cv2

        self._cv2: Any = cv2
        self._path = path
        self._silence = open(os.devnull, 'w')
        self._watch()
        self._open()
        width, height, self.frame_rate, count = (
            self._film.get(prop) for prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT,
                                              cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT))
        if width * height > MAXIMUM_PIXELS:
            os._exit(TOO_LARGE)
        if not self._film.grab():
            os._exit(UNDECODABLE)
        decoded, pixels = self._film.retrieve()
        if not decoded:
            os._exit(UNDECODABLE)
        self._last = self._time()
        self.size = pixels.shape[1], pixels.shape[0]
        if not 0.1 <= self.frame_rate <= 1000.0:
            self.frame_rate = 30.0
        # A browser that records writes neither the count of frames nor the duration.
        self.duration = count / self.frame_rate if 0 < count < 1e9 else self._whole()
        self._open()

    def answer(self, begin: float, end: float, answers: BinaryIO) -> None:
        """Write the frames with begin <= time < end."""
        self._search(begin)
        while self._time_of_next < end:
            if self._time_of_next >= begin:
                decoded, pixels = self._film.retrieve()
                if not decoded:
                    break
                if pixels.shape != (self.size[1], self.size[0], 3):
                    os._exit(CHANGED)
                pixels = self._cv2.cvtColor(pixels, self._cv2.COLOR_BGR2RGB)
                faulthandler.cancel_dump_traceback_later()  # the parent may take its time
                answers.write(FRAME.pack(self._time_of_next))
                answers.write(memoryview(pixels).cast('B'))
            self._advance()
        faulthandler.cancel_dump_traceback_later()
        answers.write(FRAME.pack(math.nan))
        answers.flush()

    def _open(self) -> None:
        self._film = self._cv2.VideoCapture(self._path, self._cv2.CAP_FFMPEG)
        if not self._film.isOpened():
            os._exit(UNREADABLE)
        self._film.set(self._cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        self._last = self._time_of_next = -math.inf

    def _search(self, begin: float) -> None:
        """Go to a frame at or before a time, if there is one."""
        if not self._time_of_next <= begin <= self._time_of_next + NEAR:
            if begin > BEFORE:
                self._film.set(self._cv2.CAP_PROP_POS_MSEC, 1e3 * (begin - BEFORE))
                self._last = -math.inf
                self._advance()
            if begin <= BEFORE or self._time_of_next > begin:
                self._open()
        if self._time_of_next == -math.inf:
            self._advance()

    def _advance(self) -> None:
        """Go to the next frame."""
        self._watch()
        if not self._film.grab():
            self._time_of_next = math.inf
            return
        self._time_of_next = self._last = self._time()

    def _time(self) -> float:
        """Return the time of the frame that was grabbed [s]; damaged films may have none."""
        time = float(self._film.get(self._cv2.CAP_PROP_POS_MSEC)) / 1e3
        if math.isfinite(time) and time > self._last:
            return time
        return float(self._last + 1.0 / self.frame_rate) if self._last > -math.inf else 0.0

    def _whole(self) -> float:
        """Return the duration of a film that does not say it [s]."""
        while self._film.grab():
            self._watch()
            self._last = self._time()
        return float(self._last + 1.0 / self.frame_rate)

    def _watch(self) -> None:
        """End the process later, unless this is called again before."""
        faulthandler.dump_traceback_later(SILENCE, exit=True, file=self._silence)
