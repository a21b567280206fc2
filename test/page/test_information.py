# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What trials tell before a calibration: when it is computed anew, and when not."""

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


def taken(found, *turns, mass=0.0):
    found.want(trials(*turns), Options(mass=mass))
    return found.take()


def test_a_new_trial_is_added_to_the_others(toy):
    found = Information(None)
    assert taken(found, 0.0)
    assert not taken(found, 0.0)
    assert taken(found, 0.0, 0.5)
    assert toy.started == [['trial 1'], ['trial 1', 'trial 2']]
    assert found.plain('trial 1') and found.plain('trial 2')


@pytest.mark.parametrize('change', [
    {'turns': (0.2, 0.5)}, {'turns': (0.5,)}, {'turns': (0.0, 0.5), 'mass': 0.1}])
def test_everything_is_computed_anew_where_an_earlier_trial_or_an_option_changes(toy, change):
    found = Information(None)
    taken(found, 0.0, 0.5)
    toy.started.clear()
    stopped = toy.stopped
    taken(found, *change['turns'], mass=change.get('mass', 0.0))
    assert toy.stopped > stopped
    assert len(toy.started) == 1


def test_trials_that_were_removed_tell_nothing(toy):
    found = Information(None)
    taken(found, 0.0, 0.5)
    taken(found, 0.0)
    assert found.plain('trial 2') is None


def test_nothing_begins_while_the_person_works_or_something_is_under_way(toy, monkeypatch):
    found = Information(None)
    monkeypatch.setattr(information, 'QUIET', 100.0)
    assert not taken(found, 0.0)
    monkeypatch.setattr(information, 'QUIET', 0.0)
    toy.alive = True
    assert not taken(found, 0.0)
    toy.alive = False
    assert taken(found, 0.0)


def test_it_goes_on_after_a_pause(toy):
    found = Information(None)
    taken(found, 0.0)
    toy.alive = True
    taken(found, 0.0, 0.5)
    found.pause()
    toy.alive = False
    taken(found, 0.0, 0.5)
    assert toy.started[-1] == ['trial 1', 'trial 2']
