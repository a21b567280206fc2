# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Run the command line as `python -m dlo_calibration`."""

import sys

from dlo_calibration.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
