# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Known outcomes of an experiment on two trials."""

from toy_messages import toy_trials

from dlo_calibration.calibration.options import Options
from dlo_calibration.experiment.study import Judgement, Observed, Outcome, Subject, Task

OPTIONS = Options.of({'calibrate': ['friction', 'elasticity']})
ROPE = Subject('rope', Observed(tuple(toy_trials(2)), OPTIONS), (0, 1))


def outcomes(seed, friction, scores, excited=('friction',), seconds=1.0):
    """Return the three calibrations of one seed: on all trials, and without each of the two."""
    values = {'friction': friction, 'elasticity': 25.0}
    whole = Outcome(values, excited, 5.0, 0.002, 100 + seed, 300, seconds)
    rest = [Outcome(values, excited, 5.0, 0.002, 100, 300, seconds, (Judgement(
        f'trial {k + 1}', score, None if score is None else score / 1000,
        None if score is None else score / 10),)) for k, score in enumerate(scores)]
    return [(Task(ROPE, 'random', seed, 'toy', left_out), outcome)
            for left_out, outcome in zip((None, 0, 1), (whole, *rest), strict=True)]
