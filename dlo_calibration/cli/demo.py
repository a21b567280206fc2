# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo: sends a sample session to the real node over the ROS graph, and shows the result.

`python -m dlo_calibration.cli.demo [--output DIR]`; it handles signals before it loads anything large.
"""

from __future__ import annotations

import sys
from typing import Sequence

from dlo_calibration.signals import end_at_signals, StopFlag


def main(args: Sequence[str] | None = None) -> int:
    """
    Execute the demo.

    :returns: exit code: 0; 1, with one line on stderr, if something did not work; 130 or 143, with one
        line, after SIGINT or SIGTERM.
    """
    end_at_signals('demo')
    import argparse
    from pathlib import Path

    from dlo_calibration.cli.demo_robot import calibrate_sample
    from dlo_calibration.errors import DloCalibrationError
    from dlo_calibration.files.session import samples

    parser = argparse.ArgumentParser(prog='demo', description='Calibrate a sample with the real node.')
    parser.add_argument('--output', type=Path, default=Path('demo_output'),
                        help='folder to write to (default: %(default)s)')
    parser.add_argument('--sample', type=Path, help='session to send (default: object1 of msg_samples)')
    parser.add_argument('--evaluations', type=int, default=100,
                        help='largest number of parameter sets to try (default: %(default)s)')
    chosen = parser.parse_args(args)
    stop = StopFlag()
    stop.listen()
    try:
        calibrate_sample(chosen.output, chosen.sample or samples() / 'object1', chosen.evaluations, stop)
    except DloCalibrationError as error:
        sys.stderr.write(f'demo: {error}\n')
        return 1
    except KeyboardInterrupt:
        sys.stderr.write('demo: interrupted\n')
        return stop.exit_code
    finally:
        stop.ignore()
    return 0


if __name__ == '__main__':
    sys.exit(main())
