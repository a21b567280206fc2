# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The executable `dlo-calibration`, which handles signals before it loads anything large."""

import os
import sys

from dlo_calibration.signals import end_at_signals, StopFlag

NAME = 'dlo_calibration'


def main() -> int:
    """Execute the command line of the process; return the exit code, as `cli.main.main` does."""
    end_at_signals('dlo-calibration')
    # Python has no stream where the parent process closed it.
    sys.stdout, sys.stderr = (stream or open(os.devnull, 'w') for stream in (sys.stdout, sys.stderr))
    try:
        from dlo_calibration.cli.main import main as execute
        from dlo_calibration.cli.output import flush

        try:
            return execute()
        finally:
            flush()
    except ModuleNotFoundError as error:
        if (error.name or NAME).startswith(NAME):
            raise
        sys.stderr.write(f'dlo-calibration: {error}; install what README.md of the package names: '
                         'rosdep install, and pip install -r requirements.txt\n')
        return 2
    finally:
        StopFlag().ignore()  # what there was to do is done


if __name__ == '__main__':
    sys.exit(main())
