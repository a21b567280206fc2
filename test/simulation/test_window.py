# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The window shows the DLO and the hands where they are at each time; tried in a world without a window."""

from itertools import count
from types import SimpleNamespace

from made_up_dlo import straight
import numpy as np
import pytest

from dlo_calibration import Action, Goal, Hand, Trial
from dlo_calibration.simulation import window
from dlo_calibration.simulation.motion import Motion
from dlo_calibration.simulation.window import pybullet, ShownMotion

RISE = np.array([0.0, 0.0, 0.1])


@pytest.fixture
def film():
    """Give the film of a DLO that a hand lifts within 1 s, and then lets go."""
    start = straight()
    action = Action((Hand('h', (20,), [0.0, 1.0], [start.points[20], start.points[20] + RISE]),))
    goals = (Goal(start, 1.0, stable=False, held_by=('h',)), Goal(start, 2.0))
    times = np.arange(0.0, 2.01, 0.5)
    chains = np.stack([start.points + min(time, 1.0) * RISE for time in times])
    return ShownMotion.of('lift', Trial('lift', start, (action,), goals), Motion(times, chains, chains[-1:]),
                   {'h': '#ff8000'}, 0.004)


@pytest.fixture
def world(monkeypatch):
    """Give a world of PyBullet; its texts are not drawn, as only a window can."""
    client = pybullet.connect(pybullet.DIRECT)
    texts = []
    monkeypatch.setattr(window, 'pybullet', SimpleNamespace(**{
        **vars(pybullet), 'addUserDebugText': lambda text, *_, **rest: texts.append(text) or 5}))
    yield SimpleNamespace(client=client, texts=texts)
    pybullet.disconnect(physicsClientId=client)


def places(client, bodies):
    return np.array([pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0]
                     for body in bodies])


def test_a_film_has_beads_that_touch_and_hands_that_open(film):
    gaps = np.linalg.norm(np.diff(film.beads[0], axis=0), axis=1)
    np.testing.assert_allclose(gaps, 0.004, rtol=0.05)
    (colour, positions, closed), = film.hands
    assert colour == pytest.approx((1.0, 0.5, 0.0), abs=0.01)
    assert closed == (True, True, True, False, False)
    np.testing.assert_allclose(positions[2], straight().points[20] + RISE)


def test_each_frame_is_shown_at_its_time(film, world):
    stage = window._Stage(world.client, [film], 0.004, 0.0)
    seen = []

    def sleep(_):
        seen.append((places(world.client, stage._beads)[-1, 2], places(world.client, stage._hands)[0, 2]))

    ticks = count()
    assert stage.show(film, lambda: next(ticks) * 0.25, sleep, lambda: False)
    assert world.texts == ['lift']
    heights, hands = np.array(seen).T
    assert heights[0] == pytest.approx(0.004, abs=1e-6) and heights[-1] == pytest.approx(0.104, abs=1e-6)
    assert (np.diff(heights) >= 0).all() and 0.054 in heights.round(6)
    np.testing.assert_allclose(heights, hands, atol=1e-6)
    assert len(seen) * 0.25 == pytest.approx(2.0 + window.PAUSE, abs=0.3)


def test_films_of_different_dlos_share_the_stage(film, world):
    short = ShownMotion('short', film.times, film.beads[:, :50], ())
    stage = window._Stage(world.client, [film, short], 0.004, None)
    ticks = count()
    assert stage.show(short, lambda: float(next(ticks)), lambda _: None, lambda: False)
    beads = places(world.client, stage._beads)
    assert len(beads) == film.beads.shape[1]
    np.testing.assert_allclose(beads[49:], np.tile(short.beads[-1, -1], (len(beads) - 49, 1)), atol=1e-6)
    assert places(world.client, stage._hands)[0, 2] < -100


def test_a_film_stops_when_the_command_ends(film, world):
    stage = window._Stage(world.client, [film], 0.004, 0.0)
    assert not stage.show(film, lambda: 0.0, lambda _: None, lambda: True)
