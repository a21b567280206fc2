# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One contract for every engine, on small trials."""

import pickle

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, PARAMETERS, ParameterSpace, Trial
from dlo_calibration.config import ENGINES as NAMES
from dlo_calibration.config import Options
from dlo_calibration.engines import ENGINES, make_simulator

SPACE = ParameterSpace(tuple(parameter.name for parameter in PARAMETERS))
MIDDLE = {'flexibility': 60.0, 'elasticity': 40.0, 'friction': 60.0, 'self_collision': 25.0, 'damping': 50.0,
          'internal_damping': 25.0, 'mass': 40.0}


def trial(held_by=()):
    """Lay the end of a short rope across its beginning: it bends, stretches, slides, and touches itself."""
    x = np.linspace(0, 0.4, 15)
    points = np.stack([x, 0.01 * np.sin(8 * x), 0 * x + 0.005], axis=1)
    path = [points[14], (0.35, -0.02, 0.06), (0.2, -0.06, 0.06), (0.1, 0.04, 0.02)]
    hand = Hand('hand', (14,), [0.0, 0.3, 0.8, 1.1], path)
    other = Hand('other', (0,), [0.0, 1.1], [points[0]] * 2)
    goals = (Goal(Chain(points), 0.5, stable=False), Goal(Chain(points), 2.0, held_by=held_by))
    return Trial('fold', Chain(points), (Action((hand, other)),), goals)


def simulator(name):
    return make_simulator(Options(engine=name, nodes=21, settle_limit=1.0))


def rollout(simulator, trial=trial(), **values):  # noqa: B008  a trial is frozen
    return simulator.simulate(trial, SPACE.physical({**MIDDLE, **values}, 0.4))


def test_what_can_be_chosen_can_be_made():
    assert tuple(ENGINES) == NAMES


@pytest.fixture(params=ENGINES)
def engine(request):
    made = simulator(request.param)
    yield made
    made.close()


def test_a_rollout_answers_every_goal_with_finite_chains(engine):
    found = rollout(engine)
    assert found.chains.shape == (2, 15, 3)
    assert np.isfinite(found.chains).all()
    assert len(found.settled) == 2
    assert found.settled[0]
    assert found.steps > 0
    assert found.duration == pytest.approx(found.steps * Options().time_step)
    with pytest.raises(ValueError):
        found.chains[0] = 0
    # The hand was there at half a second: two fifths of the way from its second waypoint to its third.
    assert found.chains[0, 14] == pytest.approx((0.29, -0.036, 0.06), abs=2e-3)


def test_it_is_known_by_its_name():
    for name in ENGINES:
        assert simulator(name).name == name


def test_the_same_call_gives_the_same_rollout_bit_for_bit(engine):
    first = rollout(engine)
    rollout(engine, trial(held_by=('hand',)), friction=5.0)
    again = rollout(engine)
    fresh = rollout(simulator(engine.name))
    assert first.chains.tobytes() == again.chains.tobytes() == fresh.chains.tobytes()
    assert first.steps == again.steps == fresh.steps


def test_it_goes_to_other_processes_before_and_after_use(engine):
    unused = pickle.loads(pickle.dumps(engine))  # noqa: S301
    first = rollout(engine)
    used = pickle.loads(pickle.dumps(engine))  # noqa: S301
    for copy in (unused, used):
        assert rollout(copy).chains.tobytes() == first.chains.tobytes()
        copy.close()
    assert rollout(engine).chains.tobytes() == first.chains.tobytes()


def test_it_can_be_closed_at_any_time_and_used_again(engine):
    engine.close()
    first = rollout(engine)
    engine.close()
    engine.close()
    assert rollout(engine).chains.tobytes() == first.chains.tobytes()


def test_two_at_a_time_do_not_disturb_each_other(engine):
    alone = rollout(engine)
    other = simulator(engine.name)
    rollout(other, friction=5.0)
    assert rollout(engine).chains.tobytes() == alone.chains.tobytes()
    other.close()
    assert rollout(engine).chains.tobytes() == alone.chains.tobytes()


@pytest.mark.parametrize('name', [parameter.name for parameter in PARAMETERS])
def test_every_parameter_changes_the_rollout(engine, name):
    # Internal damping that is less than the time step's own does nothing.
    values = (65.0, 95.0) if name == 'internal_damping' else (MIDDLE[name] - 20, MIDDLE[name] + 20)
    low, high = (rollout(engine, **{name: value}).chains for value in values)
    assert np.abs(high - low).max() > 1e-4


def test_a_held_end_stays_with_its_hand_and_a_released_one_does_not(engine):
    held = rollout(engine, trial(held_by=('hand',))).chains[1, 14]
    assert held == pytest.approx((0.1, 0.04, 0.02), abs=1e-6)
    assert np.abs(rollout(engine).chains[1, 14] - held).max() > 1e-4


def test_options_reach_the_engine():
    for name in ENGINES:
        falling = make_simulator(Options(engine=name, table=False, settle_limit=0.5, time_step=0.005))
        found = rollout(falling)
        assert found.settled == (True, False)
        assert found.chains[1, :, 2].max() < -0.5
        assert found.duration < 2.0 + 0.5 + 0.05
        falling.close()
