# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The report is written in the background, and its errors are collected, not raised."""

import errno
import os
import signal
import threading

import pytest
from toy_messages import toy_trials
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.report.page import Origin
from dlo_calibration.workspace import report_writer
from dlo_calibration.workspace.report_writer import ReportWriter, write_report

OPTIONS = Options.of({'workers': 1, 'evaluations': 20})
ORIGIN = Origin('session', 'a command', OPTIONS)


@pytest.fixture(scope='module')
def result():
    """Return a result of the toy simulator."""
    return calibrate(toy_trials(2), OPTIONS, make_simulator=new_toy)


def test_each_page_has_slices_simulated_in_another_thread(result, tmp_path, without_drawings):
    threads = []
    reporter = ReportWriter(lambda _: threads.append(threading.current_thread()) or ToySimulator())
    reporter.begin(tmp_path / 'report.html', result, ORIGIN)
    reporter.begin(tmp_path / 'report_2.html', result, ORIGIN)
    reporter._thread.shutdown()
    assert threading.current_thread() not in threads
    for file in ('report.html', 'report_2.html'):
        assert 'Along flexibility' in (tmp_path / file).read_text(encoding='utf-8')
    assert list(reporter.failures()) == []


def test_the_newest_page_keeps_its_name_though_the_one_before_is_still_being_written(
        result, tmp_path, without_drawings):
    reporter = ReportWriter(lambda _: ToySimulator(0.01))
    reporter.begin(tmp_path / 'report.html', result, Origin('session', 'the first', OPTIONS))
    reporter.begin(tmp_path / 'report.html', result, Origin('session', 'the second', OPTIONS),
                   tmp_path / 'report_1.html')
    reporter.close()
    assert 'the second' in (tmp_path / 'report.html').read_text(encoding='utf-8')
    assert 'the first' in (tmp_path / 'report_1.html').read_text(encoding='utf-8')


def test_closing_waits_for_the_page_but_not_for_its_slices(result, tmp_path, without_drawings):
    reporter = ReportWriter(lambda _: ToySimulator(0.1))  # the slices would take half a minute
    reporter.begin(tmp_path / 'report.html', result, ORIGIN)
    reporter.close()
    page = (tmp_path / 'report.html').read_text(encoding='utf-8')
    assert page.endswith('</html>\n')
    assert 'Left out' in page


@pytest.mark.parametrize('engine', [ToySimulator(crash=True), None])
def test_engine_that_fails_costs_the_slices_only(result, tmp_path, engine, without_drawings):
    reporter = ReportWriter(lambda _: engine)
    reporter.begin(tmp_path / 'report.html', result, ORIGIN)
    reporter.close()
    assert 'Left out' in (tmp_path / 'report.html').read_text(encoding='utf-8')
    assert list(reporter.failures()) == []


def test_a_page_that_cannot_be_written_is_reported_once(result, tmp_path, without_drawings):
    reporter = ReportWriter(lambda _: ToySimulator())
    reporter.begin(tmp_path / 'none' / 'report.html', result, ORIGIN)
    reporter.close()
    (path, why), = reporter.failures()
    assert path == tmp_path / 'none' / 'report.html'
    assert why == os.strerror(errno.ENOENT)
    assert list(reporter.failures()) == []


@pytest.mark.long
def test_a_drawing_process_that_is_killed_costs_the_page_only(result, tmp_path, monkeypatch):
    monkeypatch.setattr(report_writer, 'page_of', kill_this_process)
    reporter = ReportWriter(lambda _: ToySimulator())
    reporter.begin(tmp_path / 'report.html', result, ORIGIN)
    reporter.close()
    (_, why), = reporter.failures()
    assert why == 'the process that draws it was ended from outside'


@pytest.mark.long
@pytest.mark.parametrize('responsive', [False, True])
def test_pictures_are_drawn_in_another_process_only_if_this_one_must_be_responsive(
        result, tmp_path, monkeypatch, responsive):
    monkeypatch.setattr(report_writer, 'page_of', name_this_process)
    write_report(tmp_path / 'page', result, ORIGIN, new_toy, lambda: True, responsive=responsive)
    assert ((tmp_path / 'page').read_text() != name_this_process()) == responsive


def name_this_process(*_):
    return str(os.getpid())


def kill_this_process(*_):
    os.kill(os.getpid(), signal.SIGKILL)
