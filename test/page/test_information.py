# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The information of trials before a calibration: when it is computed again, and when not."""

from capture_page import ToyInformation
import pytest
from toy_simulator import toy_trial

from dlo_calibration.calibration.options import Options
from dlo_calibration.page import information
from dlo_calibration.page.information import Information

TRUTH = {'flexibility': 40.0, 'elasticity': 50.0, 'friction': 30.0, 'self_collision': 50.0}


@pytest.fixture
def toy(monkeypatch):
    appraiser = ToyInformation()
    monkeypatch.setattr(information, 'LiveInformation', lambda _: appraiser)
    monkeypatch.setattr(information, 'QUIET', 0.0)
    return appraiser


def trials(*turns):
    return [toy_trial(TRUTH, f'trial {k}', turn=turn) for k, turn in enumerate(turns, start=1)]


def news(live, *turns, mass=0.0):
    live.want(trials(*turns), Options(mass=mass))
    return live.take()


def test_a_new_trial_is_added_to_the_others(toy):
    live = Information(None)
    assert news(live, 0.0)
    assert not news(live, 0.0)
    assert news(live, 0.0, 0.5)
    assert toy.started == [['trial 1'], ['trial 1', 'trial 2']]
    assert live.plain('trial 1') and live.plain('trial 2')


@pytest.mark.parametrize('change', [
    {'turns': (0.2, 0.5)}, {'turns': (0.5,)}, {'turns': (0.0, 0.5), 'mass': 0.1}])
def test_a_change_of_an_earlier_trial_or_an_option_starts_from_the_first_trial(toy, change):
    live = Information(None)
    news(live, 0.0, 0.5)
    toy.started.clear()
    stopped = toy.stopped
    news(live, *change['turns'], mass=change.get('mass', 0.0))
    assert toy.stopped > stopped
    assert len(toy.started) == 1


def test_removed_trials_have_no_information(toy):
    live = Information(None)
    news(live, 0.0, 0.5)
    news(live, 0.0)
    assert live.plain('trial 2') is None


def test_nothing_begins_soon_after_a_change_or_while_another_appraisal_is_under_way(toy, monkeypatch):
    live = Information(None)
    monkeypatch.setattr(information, 'QUIET', 100.0)
    assert not news(live, 0.0)
    monkeypatch.setattr(information, 'QUIET', 0.0)
    toy.alive = True
    assert not news(live, 0.0)
    toy.alive = False
    assert news(live, 0.0)


def test_the_appraisal_goes_on_after_a_pause(toy):
    live = Information(None)
    news(live, 0.0)
    toy.alive = True
    news(live, 0.0, 0.5)
    live.pause()
    toy.alive = False
    news(live, 0.0, 0.5)
    assert toy.started[-1] == ['trial 1', 'trial 2']
