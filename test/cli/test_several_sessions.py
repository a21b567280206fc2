# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Several sessions of one DLO, calibrated together, with parameters that differ from session to session."""

from dataclasses import replace
from hashlib import sha256
import json

import numpy as np
import pytest
from toy_command import one_worker
from toy_simulator import new_toy, toy_trial, ToySimulator

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.cli import main as cli
from dlo_calibration.files.recording import write_records
from dlo_calibration.files.result import read_result
from dlo_calibration.files.session import read_session, trial_records
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')
TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}


@pytest.fixture
def sessions(tmp_path):
    """Give three sessions of one DLO, of two trials each; the friction is 70, 50 and 60."""
    paths = []
    for k, friction in enumerate((70.0, 50.0, 60.0)):
        trials = [toy_trial({**TRUTH, 'friction': friction}, turn=0.4 * (2 * k + n)) for n in range(2)]
        paths.append(tmp_path / f'session_{k + 1}.mcap')
        write_records(paths[-1], trial_records(trials), {'table_height': 0.0})
    return paths


@pytest.fixture
def fit(capsys):
    """Give a function that fits with the toy, and returns exit code, JSON and stderr."""
    def fit(*words, toy=None):
        code = cli.main(one_worker(['fit', *map(str, words), '--json']), lambda _: toy or ToySimulator())
        output, errors = capsys.readouterr()
        return code, json.loads(output) if output else None, errors

    return fit


@pytest.mark.long
def test_each_session_gets_a_value_of_its_own(fit, sessions):
    code, printed, _ = fit(*sessions, '--own', 'friction')
    assert code == 0
    assert printed['trials'] == 6
    found = {name: parameter['value'] for name, parameter in printed['parameters'].items()}
    assert found == pytest.approx(
        {**TRUTH, 'friction_session_2': 50.0, 'friction_session_3': 60.0}, abs=0.5)


def test_the_passport_names_all_sessions_also_those_whose_files_have_the_same_name(fit, sessions, tmp_path):
    paths = [tmp_path / name / 'session.mcap' for name in ('first', 'second')]
    for path, session in zip(paths, sessions, strict=False):
        path.parent.mkdir()
        path.write_bytes(session.read_bytes())
    assert fit(*paths, paths[0], '--evaluations', '8', '--output', tmp_path / 'out')[0] == 0
    assert read_result(tmp_path / 'out' / 'result.xml').passport.sessions == {
        name: sha256(path.read_bytes()).hexdigest()
        for name, path in zip(('session.mcap', 'second/session.mcap'), paths, strict=True)}


@pytest.mark.long
def test_one_value_for_all_fits_worse(fit, sessions):
    shared, own = (fit(*sessions, *words)[1] for words in ([], ['--own', 'friction']))
    assert 'friction_session_2' not in shared['parameters']
    assert shared['parameters']['friction']['value'] == pytest.approx(60, abs=3)
    assert shared['mean_error_m'] > 10 * own['mean_error_m']
    assert shared['parameters']['flexibility']['value'] == pytest.approx(40, abs=1)


@pytest.mark.long
def test_the_files_of_the_result_give_it_again(fit, sessions, tmp_path):
    printed = fit(*sessions, '--own', 'friction', '--without', 2, '--output', tmp_path / 'out')[1]
    assert printed['trials'] == 5
    again = fit(tmp_path / 'out' / 'session.mcap', '--without', 2)[1]
    assert again['parameters'] == printed['parameters']
    assert set(read_result(tmp_path / 'out' / 'result.xml').parameters) >= {'friction', 'friction_session_3'}
    merged = read_session(tmp_path / 'out' / 'session.mcap')
    assert [trial.session for trial in merged.trials] == [1, 1, 2, 2, 3, 3]
    assert cli.main(['validate', str(tmp_path / 'out' / 'result.xml'), str(sessions[0])], new_toy) == 0


@pytest.mark.long
def test_a_film_and_a_session_of_a_robot_are_calibrated_together(fit, sessions, tmp_path):
    film = tmp_path / 'film.mcap'
    write_records(film, trial_records(read_session(sessions[0]).trials),
                  {'table_height': 0.0, 'slow_chain_error': 0.0005, 'slow_hand_error': 0.002})
    for paths in ([film, sessions[1]], [sessions[1], film]):
        code, _, _ = fit(*paths, '--output', tmp_path / 'both', '--evaluations', 20)
        assert code == 0
        options = read_session(tmp_path / 'both' / 'session.mcap').file_options.values
        assert (options['slow_chain_error'], options['slow_hand_error']) == (0.0005, 0.002)


@pytest.mark.long
def test_an_interrupted_calibration_of_several_sessions_goes_on(fit, sessions, tmp_path):
    class Dying(ToySimulator):
        count = 0

        def simulate(self, trial, physical):
            self.count += 1
            if self.count > 60:
                raise KeyboardInterrupt
            return super().simulate(trial, physical)

    words = [*sessions, '--own', 'friction', '--output', tmp_path / 'out']
    code = fit(*words, toy=Dying())[0]
    assert code != 0
    resumed = fit('--resume', tmp_path / 'out')[1]
    assert resumed['parameters'] == fit(*sessions, '--own', 'friction')[1]['parameters']


@pytest.mark.long
def test_impossible_sessions_are_refused(fit, sessions, tmp_path):
    code, _, said = fit(sessions[0], '--own', 'friction')
    assert code == 2
    assert 'several sessions' in said
    higher = tmp_path / 'higher.mcap'
    write_records(higher, trial_records([toy_trial(TRUTH)]), {'table_height': -0.5})
    code, _, said = fit(sessions[0], higher)
    assert code == 2
    assert 'table_height' in said
    assert fit(sessions[0], higher, '--table-height', '-0.5')[0] == 0
    code, _, said = fit(sessions[0], '--sessions', '4 3')
    assert code == 2
    assert 'add up to 2' in said
    code, _, said = fit(sessions[0], '--sessions', 'four')
    assert code == 2


@pytest.mark.long
def test_a_load_is_weighed_where_the_mass_is_known_in_another_session():
    """EI is known from the session whose mass is known; so the other session shows its mass."""
    generator = np.random.default_rng(1)
    along = np.linspace(0, 0.6, 21)
    simulator = CompiledSimulator()
    trials = []
    for session, mass in ((1, 0.03), (2, 0.075)):
        stiffness = {'flexibility': BY_NAME['flexibility'].value(2e-3)}
        physical = ParameterSpace(mass=mass).physical(stiffness, 0.6)
        level = physical['self_collision']
        for k, height in enumerate((0.15, 0.25)):
            initial = np.stack([along, np.full(21, 0.2 * k), np.full(21, level)], axis=1)
            path = initial[-1] + np.array([[0, 0, 0], [-0.1, 0, height]])
            hand = Hand('hand', (20,), np.array([0.5, 2.5]), path)
            draft = Trial(f'trial {len(trials) + 1}', Chain(initial), (Action((hand,)),),
                          (Goal(Chain(initial), 3.0, held_by=('hand',)),), session=session)
            points = simulator.simulate(draft, physical).chains[0]
            noise = generator.normal(0, 2e-4, (2, 21, 3))
            trials.append(replace(draft, initial=Chain(initial + noise[0]), goals=(
                Goal(Chain(points + noise[1]), 3.0, held_by=('hand',)),)))
    result = calibrate(trials, Options(mass=0.03, calibrate=('flexibility', 'friction'), own=('mass',),
                                       sessions='2 2', workers=1, parts=1, engine='compiled'))
    load = result.parameters['mass_session_2']
    assert load.physical_value == pytest.approx(0.075, rel=0.1)
    assert load.physical_lower < 0.075 < load.physical_upper
    assert result.parameters['flexibility'].physical_value == pytest.approx(2e-3, rel=0.1)
