# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The command line with the toy as its engine: `toy_command.py SECONDS_PER_SIMULATION VERB ...`."""

import functools
import sys

from toy_calibrator import make_toy

from dlo_calibration import __main__ as program
from dlo_calibration.cli import main as cli


def one_worker(words):
    """Return the words of a command line, with one worker for `fit` unless they name a number."""
    words = [str(word) for word in words]
    return words if words[:1] != ['fit'] or '--workers' in words else [*words, '--workers', '1']


def main():
    """Execute the verb, as `dlo_calibration.__main__` does."""
    cli.main.__defaults__ = (None, functools.partial(make_toy, float(sys.argv.pop(1))))
    return program.main()


if __name__ == '__main__':
    sys.exit(main())
