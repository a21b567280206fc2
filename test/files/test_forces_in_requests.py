# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Forces in XML requests and in recorded bags, and what the command line makes of them."""

import json

from felt_trials import felt_trials, LIFTS, ROPE
import numpy as np
import pytest
from toy_command import one_worker

from dlo_calibration import InputError, Options
from dlo_calibration.cli import main as cli
from dlo_calibration.files.record import encode, Record
from dlo_calibration.files.recording import write_records
from dlo_calibration.files.request import read_request, Request, request_of, request_trials, TrialRequest
from dlo_calibration.files.session import read_session, session_trials, trial_records
from dlo_calibration.messages.codec import bag_types, built, INPUT_TYPES, WRENCH, WrenchMessage
from dlo_calibration.simulation.compiled import CompiledSimulator

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')


@pytest.fixture(scope='module')
def felt():
    """Give two trials with forces, one of them of a sensor with an unknown offset."""
    tared, = felt_trials(1, lifts=LIFTS[:1])
    untared, = felt_trials(2, lifts=LIFTS[1:2], offset=np.array([0, 0, -1.0]))
    return tared, untared


def document(felt):
    return Request(tuple(map(TrialRequest.of, felt))).document


def test_forces_survive_a_request_to_the_digit(felt, tmp_path):
    (tmp_path / 'felt.xml').write_bytes(document(felt))
    trials, refusals = request_trials(read_request(tmp_path / 'felt.xml'), Options())
    assert not refusals
    for trial, sent in zip(trials, felt, strict=True):
        for (k, hand, force), (k_sent, hand_sent, force_sent) in zip(trial.forces, sent.forces, strict=True):
            assert (k, hand.name, force.tared) == (k_sent, hand_sent.name, force_sent.tared)
            np.testing.assert_array_equal(force.vector, force_sent.vector)


@pytest.mark.parametrize(('wrong', 'words'), [
    (b'hand="left"', "a force on 'left' in goal 1"), (b'hand="hand_1" x="nan"', 'nan'),
    (b'hand="hand_1" x="1e9"', 'three finite numbers up to 1e'), (b'', "attribute 'hand'")])
def test_a_force_that_cannot_be_is_refused_with_its_line(felt, wrong, words):
    good = document(felt)
    start = good.index(b'<force') + len(b'<force ')
    end = good.index(b'y=', start)
    text = wrong if b'x=' in wrong or not wrong else wrong + b' x="0.1"'
    text = text or b'x="0.1"'
    with pytest.raises(InputError, match=words.replace("'", '.')) as error:
        request_of(good[:start] + text + b' ' + good[end:])
    assert 'line' in str(error.value)


def bag(path, trials, extra=()):
    """Record trials, with their wrenches on the topic of a broadcaster."""
    records = [Record('/ft_broadcaster/wrench' if record.name == WRENCH else record.topic, record.type,
                      record.data, record.log_time) for record in trial_records(trials)]
    records += [Record('/ft_broadcaster/wrench', INPUT_TYPES[WRENCH], encode(
        built(bag_types(), message), INPUT_TYPES[WRENCH]), message.stamp) for message in extra]
    write_records(path, records, None)
    return path


def test_a_bag_with_the_topic_of_a_broadcaster_has_forces(felt, tmp_path):
    path = bag(tmp_path / 'bag.mcap', felt[:1], [WrenchMessage(10**9, 'elbow', np.zeros(3))])
    trials, refusals = session_trials(read_session(path), Options())
    assert len(trials[0].forces) == 2
    assert refusals == ("wrench of 'elbow': no hand of this name in any action; expected one of hand_1; "
                        'let frame_id name the hand, as in joint_names',)


@pytest.mark.long
def test_the_command_line_finds_the_mass_from_a_bag(tmp_path, capsys):
    path = bag(tmp_path / 'bag.mcap', felt_trials(1, lifts=LIFTS[:3]))
    words = one_worker(['fit', str(path), '--json', '--seed', '1', '--output', str(tmp_path / 'fitted')])
    assert cli.main(words, lambda _: CompiledSimulator(nodes=31)) == 0
    found = json.loads(capsys.readouterr().out)
    mass = found['parameters']['mass']
    assert mass['physical_lower'] < ROPE['mass'] < mass['physical_upper']
    assert len(found['force_error_n']) == 3
    assert cli.main(['info', str(path), '--json']) == 0
    assert [trial['forces'] for trial in json.loads(capsys.readouterr().out)['trials']] == [2, 2, 4]
