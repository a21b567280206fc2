# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels are compiled in another process; whoever waits for them can be stopped."""

import os
import threading

from processes import simulating
import pytest
from slow_compiler import compile_at_once, compile_slowly

from dlo_calibration import DloCalibrationError
from dlo_calibration.evaluation import compiling
from dlo_calibration.evaluation.compiling import Compiling

PATIENCE = 60.0  # s


@pytest.fixture
def begun(monkeypatch):
    """Give a function that begins a compilation with a compiler, which need not be used if None."""
    made = []

    def begin(compiler, **arguments):
        monkeypatch.setattr(compiling, 'is_compiled', lambda module: compiler is None)
        monkeypatch.setattr(compiling, 'compile_kernels', compiler)
        made.append(Compiling(**arguments))
        made[-1].begin()
        return made[-1]

    yield begin
    for one in made:
        one.close()


def test_it_tells_that_it_compiles_and_then_how_long_it_took(begun):
    loaded = threading.Event()
    one = begun(compile_at_once, then=loaded.set)
    one.wait()
    assert loaded.is_set() and one.done
    first, last, *_ = one.news()  # it may have gone on with others
    assert first == 'compiling the simulation for this machine, once, about half a minute'
    assert last.startswith('the simulation is compiled, after ')


def test_what_is_compiled_already_is_only_loaded_and_nothing_is_told(begun):
    loaded = threading.Event()
    one = begun(None, then=loaded.set)
    one.wait()
    assert loaded.is_set() and not list(one.news()) and one.under_way == ''


def test_who_waits_can_be_stopped_and_closing_ends_the_process(begun):
    loaded = threading.Event()
    one = begun(compile_slowly, then=loaded.set)
    with pytest.raises(DloCalibrationError, match='it was stopped while the engine was being'):
        one.wait(lambda: one.under_way != '')
    assert not one.done
    one.close()
    one.wait()
    assert not loaded.is_set()
    assert not simulating(os.getpid())
