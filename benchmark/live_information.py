# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare the standard deviations that the status promises while trials are collected with those of the result.

    python benchmark/live_information.py

The trials of each sample are appraised one after another, as the node does, and then calibrated; so are four
actions of each reference object with two draws of the noise, and two recordings of a tracked cable, both from
DLO_DATA and only where it is.  The table is printed, and written to benchmark/results/live_information.md.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
import sys
import tempfile
from typing import Iterator, Sequence

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from accuracy import convert  # noqa: E402
from discretisation import DATA, exact_trials  # noqa: E402
from intervals import FITTED, noisy  # noqa: E402

from dlo_calibration import read_session, Trial  # noqa: E402
from dlo_calibration.calibration.calibrate import fitted  # noqa: E402
from dlo_calibration.calibration.engines import make_simulator  # noqa: E402
from dlo_calibration.calibration.options import Options  # noqa: E402
from dlo_calibration.calibration.setting import Setting  # noqa: E402
from dlo_calibration.inference.trial_information import TrialInformation  # noqa: E402
from dlo_calibration.model.parameters import extents, SCALE  # noqa: E402
from dlo_calibration.workspace.live_information import LiveInformation  # noqa: E402

DRAWS = 2  # of the noise of each reference object
CABLE, RECORDINGS = 'dlo2', '0,8'


def subjects(folder: Path) -> Iterator[tuple[str, Sequence[Trial], Options]]:
    """Yield names, trials and options."""
    for k in range(1, 6):
        session = read_session(HERE.parent / 'msg_samples' / f'object{k}')
        yield f'sample {k}', session.trials, session.options
    if not DATA.is_dir():
        return
    for k in range(1, 6):
        properties, exact = exact_trials(f'object{k}')
        for seed in range(DRAWS):
            generator = np.random.default_rng(seed)
            trials = [noisy(trial, generator) for trial in exact if trial.name in FITTED]
            yield f'object {k}, draw {seed + 1}', trials, Options(mass=properties['mass'])
    session = read_session(convert('mocap', CABLE, folder / CABLE, '--recordings', RECORDINGS))
    yield f'cable {CABLE}', session.trials, session.options


def promised(trials: Sequence[Trial], options: Options) -> TrialInformation:
    """Return the information in the status after the last trial."""
    appraiser = LiveInformation(make_simulator)
    for count in range(1, len(trials) + 1):
        appraiser.start(trials[:count], options)
        appraiser.join()
        *_, last = appraiser.waiting_information()
    return last


def main() -> None:
    """Make the table."""
    rows = ['| subject | trials | parameter | promised std | found std | promised / found '
            '| promised verdict | verdict |', '|' + '---|' * 8]
    ratios, agreed = defaultdict(list), []
    with tempfile.TemporaryDirectory() as folder:
        for name, trials, options in subjects(Path(folder)):
            promise = promised(trials, options)
            result = fitted(Setting(tuple(trials), options, make_simulator(options)))
            scale = SCALE / extents(promise.names)
            for k, parameter in enumerate(promise.names):
                estimate = result.parameters[parameter]
                std = float(promise.after[k] * scale[k])
                ratios[parameter].append(std / estimate.std)
                agreed.append(promise.verdicts[k] == estimate.verdict)
                rows.append(f'| {name} | {len(trials)} | {parameter} | {std:.2f} | {estimate.std:.2f} '
                            f'| {std / estimate.std:.2f} | {promise.verdicts[k]} | {estimate.verdict} |')
            print(*rows[-len(promise.names):], sep='\n', flush=True)
    summary = ['| parameter | subjects | promised / found, median | smallest | largest |', '|' + '---|' * 5]
    summary += [f'| {name} | {len(some)} | {np.median(some):.2f} | {min(some):.2f} | {max(some):.2f} |'
                for name, some in ratios.items()]
    text = ('# live_information\n\n`python benchmark/live_information.py`: standard deviations on the 0..100 '
            'scale.\n\n' + '\n'.join(summary) + f'\n\n{sum(agreed)} of {len(agreed)} promised verdicts are '
            'those of the result.\n\n' + '\n'.join(rows) + '\n')
    (HERE / 'results' / 'live_information.md').write_text(text, encoding='utf-8')
    print(*summary, text.split('\n\n')[3], sep='\n')


if __name__ == '__main__':
    main()
