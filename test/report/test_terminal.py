# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The progress bar derives the time left only from simulations of this process."""

import io

from dlo_calibration.planning.planner import PlanProgress
from dlo_calibration.report.terminal import PlanBar, SearchBar


class Terminal(io.StringIO):
    """Text that is shown on a terminal."""

    def isatty(self):
        return True


def last_line(logged):
    """Return the last line of a bar after eight of ten evaluations."""
    stream = Terminal()
    with SearchBar(10, stream, logged=logged) as bar:
        for count in range(1, 9):
            bar.move(count, 5.0)
    return next(line for line in reversed(stream.getvalue().splitlines()) if '8/10' in line)


def test_evaluations_from_a_log_do_not_count_for_the_time_left(monkeypatch):
    monkeypatch.setenv('TERM', 'xterm')
    assert '-:--:--' not in last_line(0)
    assert '-:--:--' in last_line(8)


def test_a_plan_shows_its_best_error_and_the_time_left(monkeypatch):
    monkeypatch.setenv('TERM', 'xterm')
    stream, quiet = Terminal(), Terminal()
    for target, shown in ((stream, True), (quiet, False)):
        with PlanBar(target, shown) as bar:
            bar.take(PlanProgress(actions=2, rollouts=100, expected=400, best_error=0.012, seconds_left=7.4))
    assert all(words in stream.getvalue() for words in ('planning action 2', '100/400', '12 mm', '7 s left'))
    assert quiet.getvalue() == ''
