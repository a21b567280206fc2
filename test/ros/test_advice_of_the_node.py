# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The node says what to do next, ends by itself when what is wanted is reached, and says why."""

import numpy as np
import pytest
from toy_graph import ToyGraph, TYPES
from toy_messages import session_messages
from toy_simulator import ToySimulator

from dlo_calibration.errors import InputError
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import chain_cloud, INITIAL
from dlo_calibration.model.chain import Chain
from dlo_calibration.ros.calibrator_options import CalibratorOptions
from dlo_calibration.ros.session import QUIET

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')


@pytest.fixture
def start(tmp_path):
    """Give a function that begins a session with the toy, and returns its graph."""
    graphs = []

    def start(**options):
        graphs.append(ToyGraph(tmp_path, lambda _: ToySimulator(), **options))
        return graphs[-1]

    yield start
    for graph in graphs:
        graph.session.close()


def advised(graph, count):
    """Wait for advice number `count`, and return it."""
    graph.elapsed += 2 * QUIET
    graph.until(lambda: len(graph.heard['advice']) >= count)
    graph.session.tick()
    return graph.heard['advice'][-1]


@pytest.mark.long
def test_advice_comes_for_the_first_chain_and_after_a_trial(start):
    graph = start(wanted='flexibility 0.01', height=0.08)
    messages = session_messages(TYPES, 1)
    graph.send(messages[:1])
    first = advised(graph, 1)
    assert first.joint_names == ['hand_1'] and len(first.points) > 1
    heights = [point.transforms[0].translation.z for point in first.points]
    assert max(heights) - heights[0] <= 0.0801
    assert float(graph.status['half_width_flexibility']) == pytest.approx(47.5 * 4.5 / 6.5, abs=0.1)
    assert float(graph.status['wanted_half_width_flexibility']) == pytest.approx(0.01)
    assert graph.status['advice'].startswith('hand_1: grip')
    graph.send(messages[1:])
    advised(graph, 2)
    assert float(graph.status['half_width_flexibility']) < 5


@pytest.mark.long
def test_a_chain_that_has_not_moved_asks_for_no_other_advice(start):
    graph = start()
    chain = chain_cloud(TYPES, Chain(np.column_stack([np.linspace(0, 1, 11), np.zeros(11), np.zeros(11)])),
                        1_000_000_000, 'world')
    graph.send([(INITIAL, chain)])
    advised(graph, 1)
    for _ in range(5):
        graph.elapsed += 2 * QUIET
        graph.session.tick()
    assert not graph.session._live_information.alive
    assert len(graph.heard['advice']) == 1


@pytest.mark.long
def test_other_limits_give_other_advice(start):
    """As where a robot cannot do what was advised."""
    graph = start()
    graph.send(session_messages(TYPES, 1)[:1])
    first = advised(graph, 1)
    assert len(first.joint_names) == 1
    graph.set.update(kinds=['drag'], height=0.2)
    graph.session.change_options()
    second = advised(graph, 2)
    heights = [point.transforms[0].translation.z for point in second.points]
    assert max(heights) - min(heights) < 0.01


def test_it_calibrates_when_what_is_wanted_is_reached(start):
    graph = start(wanted='flexibility 20')
    graph.send(session_messages(TYPES, 2))
    graph.elapsed += 2 * QUIET
    graph.until(lambda: graph.heard['result'])
    graph.until(lambda: graph.status['state'] == 'done')
    last = graph.heard['advice'][-1]
    assert not last.points and not last.joint_names
    assert graph.status['advice'] == 'each wanted parameter is certain enough'


def test_after_a_crash_it_goes_on_with_the_trials_so_far(start, tmp_path):
    messages = session_messages(TYPES, 2)
    crashed = start(wanted='flexibility 20')
    crashed.send(messages[:4])  # the second trial had only begun
    before = crashed.session._collector.trials
    folder = crashed.session._recorder.folder
    again = start(wanted='flexibility 20', resume=str(folder), output_directory=str(tmp_path / 'again'))
    trial, = again.session._collector.trials
    assert (trial.goals[0].chain.points == before[0].goals[0].chain.points).all()
    again.send(messages[4:])
    again.elapsed += 2 * QUIET
    again.until(lambda: again.heard['result'])
    # The new recording has all of them: it gives the same trials.
    recorded = read_session(again.session._recorder.folder).trials
    for own, other in zip(recorded, again.session._collector.trials, strict=True):
        assert (own.goals[-1].chain.points == other.goals[-1].chain.points).all()


def test_a_session_that_cannot_be_read_is_refused(start, tmp_path):
    with pytest.raises(InputError, match='no_such'):
        start(resume=str(tmp_path / 'no_such'))


def test_nothing_wanted_starts_nothing(start):
    graph = start()
    graph.send(session_messages(TYPES, 2))
    advised(graph, 1)
    assert graph.status['state'] == 'collecting' and not graph.heard['result']


def test_what_is_not_calibrated_cannot_be_wanted_and_the_node_goes_on(start):
    graph = start(wanted='damping 3')
    graph.send(session_messages(TYPES, 1))
    last = advised(graph, 1)
    assert not last.points
    assert 'add damping to calibrate' in graph.status['advice']
    assert graph.status['state'] == 'collecting'


def test_sessions_record_the_options_of_the_calibration_alone():
    options = CalibratorOptions(wanted='friction 3', hands=2, mass=0.03)
    assert options.of_calibration.mass == 0.03
    assert 'wanted' not in options.of_calibration.flat()
    assert (options.of_advice.wanted, options.of_advice.hands) == ('friction 3', 2)
