# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The style and type checks of the project, as tests."""

from importlib.util import find_spec
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]


def findings(*arguments):
    """Return what a tool says about the repository, or nothing where it is content."""
    if find_spec(arguments[0]) is None:
        pytest.skip(f'{arguments[0]} is not installed; the extra "test" of setup.py has it')
    done = subprocess.run([sys.executable, '-m', *arguments], cwd=ROOT, capture_output=True, text=True)
    return f'{done.stdout}{done.stderr}' if done.returncode else ''


def test_ruff_finds_nothing():
    errors = findings('ruff', 'check', '--output-format', 'concise')
    assert not errors, errors


@pytest.mark.long  # make lint and continuous integration execute it
@pytest.mark.skipif(np.lib.NumpyVersion(np.__version__) < '2.0.0', reason='types of numpy 1 are less exact')
def test_mypy_finds_nothing():
    errors = findings('mypy')
    assert not errors, errors


@pytest.mark.long
def test_benchmarks_and_examples_use_only_what_the_package_has():
    """They run for too long to be tests; without this, they break when something they use moves."""
    scripts = [str(path) for pattern in ('benchmark/*.py', 'examples/*.py') for path in ROOT.glob(pattern)]
    errors = findings('mypy', '--config-file=', '--check-untyped-defs', '--ignore-missing-imports',
                     '--follow-imports=silent', '--hide-error-context', *scripts)
    wrong = [line for line in errors.splitlines()
             if line.endswith(('[attr-defined]', '[call-arg]', '[name-defined]', '[syntax]'))]
    assert not wrong, '\n'.join(wrong)
