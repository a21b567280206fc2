# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Tally: what a campaign tried, and what became of it; and processes whose memory is measured."""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

MEGABYTE = 1e6  # bytes
POLL = 0.02  # s between two looks at the memory of a process


@dataclass
class Tally:
    """
    What a campaign tried, and what became of it.

    :param lost: things that should still be there afterwards, and are not.
    :param died: processes that ended in another way than they should.
    :param peak: largest resident memory of any process [bytes].
    :param silence: longest time without an answer [s].
    """

    tried: int = 0
    refused: int = 0
    lost: int = 0
    died: int = 0
    peak: int = 0
    silence: float = 0.0

    def remember(self, *, peak: int = 0, silence: float = 0.0) -> None:
        """Raise the largest memory [bytes] and the longest silence [s] to these, if they are below."""
        self.peak, self.silence = max(self.peak, peak), max(self.silence, silence)

    def row(self) -> tuple[str, ...]:
        """Return the cells of a table."""
        return (f'{self.tried}', f'{self.refused}', f'{self.lost}', f'{self.died}',
                f'{self.peak / MEGABYTE:.0f} MB', f'{self.silence:.2f} s')


def peak_of(pid: int) -> int:
    """Return the largest resident memory of a process so far [bytes]."""
    for line in Path(f'/proc/{pid}/status').read_text().splitlines():
        if line.startswith('VmHWM:'):
            return int(line.split()[1]) * 1024
    return 0


@dataclass(frozen=True)
class Ended:
    """
    A process that ended.

    :param code: its exit code; negative: the signal that killed it; None: it had to be killed at the limit.
    :param peak: its largest resident memory [bytes].
    :param seconds: how long it took.
    """

    code: int | None
    out: str
    err: str
    peak: int
    seconds: float


def finish(*command: object, folder: Path, limit: float = 60.0, environment: dict[str, str] | None = None
           ) -> Ended:
    """
    Execute a command to its end, or for `limit` [s]; it is killed then.

    :param folder: where it works, and where its output is kept.
    """
    begun = time.monotonic()
    with (folder / 'out').open('w+b') as out, (folder / 'err').open('w+b') as err:
        process = subprocess.Popen([str(part) for part in command], stdin=subprocess.DEVNULL, stdout=out,
                                   stderr=err, cwd=folder, env={**os.environ, **(environment or {})})
        ended, status, peak, killed = 0, 0, 0, False
        while not ended:
            # What the system tells at its end contains the memory of this process, from which it began.
            peak = max(peak, peak_of(process.pid))
            if not killed and time.monotonic() - begun > limit:
                os.kill(process.pid, signal.SIGKILL)
                killed = True
            time.sleep(POLL)
            ended, status = os.waitpid(process.pid, os.WNOHANG)
        process.returncode = os.waitstatus_to_exitcode(status)
        texts = []
        for stream in (out, err):
            stream.seek(0)
            texts.append(stream.read().decode(errors='replace'))
    return Ended(None if killed else process.returncode, *texts, peak, time.monotonic() - begun)


def verb(*arguments: object, folder: Path, limit: float = 60.0) -> Ended:
    """Execute a verb of `dlo-calibration` in a process of its own, as `finish` does."""
    return finish(sys.executable, '-m', 'dlo_calibration', *arguments, folder=folder, limit=limit)
