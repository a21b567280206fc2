# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What cannot be planned is refused in one sentence; why a goal cannot be reached exactly is told."""

from dataclasses import replace

from calibrated import HOSE, LENGTH, LEVEL, MadeUpDlo, ROPE, straight
import numpy as np
import pytest
from toy_simulator import ToySimulator

from dlo_calibration import Chain, InputError, Options
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.evaluation import Pool
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.planning.checks import checked, remarks, sharpest_bend
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.rehearsal import Rehearser

FRACTIONS = np.linspace(0, 1, 21)


def laid(x, y, z=LEVEL):
    """Return a chain from coordinates, in lengths of the DLO; z [m]."""
    x, y, z = np.broadcast_arrays(LENGTH * x, LENGTH * y, z)
    return Chain(np.stack([x, y, z], axis=1))


def arc(angle, points=21):
    """Return a DLO that lies as an arc of a circle."""
    at = angle * np.linspace(0, 1, points)
    return laid(np.sin(at) / angle, (1 - np.cos(at)) / angle)


def loop():
    """Return a DLO that lies across itself once."""
    at = np.linspace(0, 1, 1000)
    curve = laid(at + 0.4 * np.sin(2 * np.pi * at), np.cos(2 * np.pi * at), 0.0)
    return Chain(curve.resample(FRACTIONS * curve.length) * LENGTH / curve.length + [0, 0, LEVEL])


def check(goal, start=None, found=None, simulation=None, **options):
    return checked(found or MadeUpDlo(), start or straight(), goal, simulation or Options(),
                   PlanOptions.of(options))


def lifted(chain, by):
    """Return a chain whose last quarter rises, at its end by a height [m]."""
    return Chain(chain.points + by * np.maximum(4 * FRACTIONS - 3, 0)[:, None] * [0, 0, 1])


def test_start_and_goal_of_the_same_dlo_stay_as_they_are():
    start, goal = straight(), arc(1.5)
    found = check(goal, start)
    assert found[0] is start and found[1] is goal


def test_another_number_of_points_or_spacing_is_resampled_at_the_fractions_of_the_start():
    uneven = arc(1.5).resample(FRACTIONS**2 * LENGTH)
    for other in (arc(1.5, 50), Chain(uneven)):
        _, goal = check(other)
        np.testing.assert_allclose(goal.points, arc(1.5).points, atol=1e-3)
        np.testing.assert_allclose(goal.arc_lengths() / goal.length, FRACTIONS, atol=1e-3)


def test_a_drawn_goal_gets_the_height_at_which_the_dlo_lies():
    flat = laid(FRACTIONS, 0.1, 0.0)
    _, goal = check(replace(flat, features=FRACTIONS == 0.5))
    np.testing.assert_allclose(goal.points - flat.points, np.tile([0, 0, LEVEL], (21, 1)), atol=1e-12)
    assert goal.features.sum() == 1
    on_a_scene = Options(scene='scene.urdf')
    assert (check(flat, simulation=on_a_scene)[1].points == flat.points).all()


def test_noise_of_a_camera_changes_nothing():
    noise = np.random.default_rng(1).normal(0, 0.002, (2, 21, 3))
    start, goal = Chain(straight().points + noise[0]), Chain(arc(1.5).points + noise[1])
    found = check(goal, start)
    assert found[0] is start
    np.testing.assert_allclose(found[1].points, goal.points, atol=2e-3)


def without(name):
    """Return a DLO with an interval that is not known."""
    return MadeUpDlo({**ROPE, name: (50.0, float('nan'), 60.0)})


@pytest.mark.parametrize('wrong, thing, came', [
    ({'goal': arc(1.5), 'found': without('friction')}, 'result', 'no number for friction'),
    ({'goal': arc(1.5), 'found': MadeUpDlo(length=float('nan'))}, 'result', 'no number for length or errors'),
    ({'goal': Chain(1e3 * straight().points)}, 'goal chain', 'a length of 600000 mm'),
    ({'goal': Chain(0.85 * arc(1.5).points)}, 'goal chain', 'a length of 510 mm'),
    ({'goal': arc(1.5), 'start': Chain(1.2 * straight().points)}, 'start chain', 'a length of 720 mm'),
    ({'goal': arc(1.5), 'found': MadeUpDlo(length=0.5)}, 'start chain', 'a length of 600 mm'),
    ({'goal': lifted(straight(), 0.1)}, 'goal chain', 'points 4 to 104 mm above the table'),
    ({'goal': laid(FRACTIONS, 0.0, 0.3)}, 'goal chain', 'points 300 to 300 mm above the table'),
    ({'goal': arc(1.5), 'start': lifted(straight(), 0.1)}, 'start chain',
     'points 4 to 104 mm above the table'),
    ({'goal': straight(), 'simulation': Options(table=False)}, 'parameter table', 'false, and no scene'),
    ({'goal': arc(1.5), 'no_go': ['-1 -1 -1 0 0 1', '0.1 0.1 0 1 1 1']}, 'goal chain',
     'a part in the no-go box -1 -1 -1 0 0 1'),
    ({'goal': loop()}, 'goal chain', '1 crossing(s) of the DLO with itself more than in the start'),
], ids=lambda one: one if isinstance(one, str) else '-')
def test_what_cannot_be_planned_is_refused_in_one_sentence(wrong, thing, came):
    with pytest.raises(InputError) as refusal:
        check(**wrong)
    assert (refusal.value.thing, refusal.value.came) == (thing, came)
    assert refusal.value.expected and refusal.value.remedy and len(str(refusal.value)) <= 300


def test_the_refused_goals_are_taken_where_the_options_allow_them():
    across = loop()
    assert check(across, crossings=True)[1] is check(across, start=loop())[1] is across
    high = [Chain(chain.points + [0, 0, 0.7]) for chain in (arc(1.5), straight())]
    assert check(*high, simulation=Options(table_height=0.7))[0] is high[1]
    on_a_scene = check(lifted(straight(), 0.1), simulation=Options(table=False, scene='scene.urdf'))
    assert on_a_scene[1].points[-1, 2] == pytest.approx(LEVEL + 0.1)


@pytest.mark.parametrize('text, problem', [
    ('0,0,0\n1,0,0\n', '2 point(s)'), ('0,0,0\n0.1,nan,0\n0.2,0,0\n', 'NaN in point(s) 1'),
    ('', '0 point(s)'), ('0,0\n', "'0,0'"), ('0,0,0\n0,0,0\n1,0,0\n', 'coincident neighbours'),
    ('x,y,z\n', "'x,y,z'")])
def test_a_file_that_is_no_chain_is_refused_in_one_sentence(text, problem, tmp_path):
    path = tmp_path / 'goal.csv'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match='^chain .*goal.csv') as refusal:
        read_chain_file(path)
    assert problem in refusal.value.came


# ---- remarks

def told(goal, found=None, start=None, **options):
    """Return the remarks on a goal."""
    chosen = PlanOptions.of({'tolerance': 1.0, **options})
    found = found or MadeUpDlo()
    start, goal = checked(found, start or straight(), goal, Options(), chosen)
    simulator = make_simulator(Options())
    rehearse = Rehearser(Pool(simulator))
    try:
        return remarks(rehearse, Posterior.of(found), start, goal, chosen)
    finally:
        simulator.close()
        assert rehearse.count <= 4


def test_nothing_is_said_of_a_goal_in_which_the_dlo_stays():
    assert told(arc(1.5)) == ()


def test_a_stiff_dlo_springs_back_and_a_large_tolerance_makes_that_unimportant():
    sentence, = told(arc(4.0), MadeUpDlo(HOSE))
    assert sentence.startswith('laid exactly on the goal and let go, the DLO springs back by ')
    assert ('at 0.00 of the length' in sentence) or ('at 1.00 of the length' in sentence)
    back = float(sentence.split('springs back by ')[1].split(' mm')[0])
    end = float(sentence.split('and by ')[1].split(' mm')[0])
    assert 10 < back < end < 300
    assert told(arc(4.0), MadeUpDlo(HOSE), tolerance=90.0) == ()
    assert told(arc(4.0)) == ()  # the rope stays


def bent(radius):
    """Return a DLO with a bend of 90 degrees in its middle, between straight parts; radius in lengths."""
    along = np.linspace(0, 1, 2001)
    heading = np.clip((along - 0.5) / radius + np.pi / 4, 0, np.pi / 2)
    x, y = (np.concatenate([[0], np.cumsum(f((heading[1:] + heading[:-1]) / 2) * along[1])])
            for f in (np.cos, np.sin))
    return laid(x[::100], y[::100])


def test_the_sharpest_bend_that_friction_holds_is_told():
    """With stiffness EI = 2e-3 N m^2, friction 0.4 and a weight of 0.6 N/m it is (2e-3 / 0.24)^(1/3) m."""
    known = {'flexibility': 2e-3, 'friction': 0.4, 'mass': 0.06 / 9.81}
    assert sharpest_bend(known, 0.1) == pytest.approx(0.2027, rel=1e-3)
    stiff = MadeUpDlo({**HOSE, 'flexibility': (50.0, 49.0, 51.0)})
    radius = sharpest_bend(Posterior.of(stiff).best, LENGTH) / LENGTH
    assert 0.1 < radius < 0.3
    assert told(bent(1.2 * radius), stiff) == ()
    sentence, = told(bent(0.5 * radius), stiff)
    assert f'friction holds only bends with a radius above about {1e3 * LENGTH * radius:.0f} mm' in sentence


def test_a_goal_that_cannot_be_simulated_is_told():
    found = MadeUpDlo()
    rehearse = Rehearser(Pool(ToySimulator(fail_below=101)))
    sentence, = remarks(rehearse, Posterior.of(found), straight(), arc(1.5), PlanOptions(draws=0))
    assert sentence.startswith('whether the DLO stays on the goal cannot be told: ')


def test_a_goal_of_another_length_cannot_be_met():
    sentence, = told(Chain(1.05 * arc(1.5).points + [0, 0, -0.05 * LEVEL]))
    assert sentence == ('the goal is 5.0 % longer than the DLO, 630 mm instead of 600 mm, so its points stay '
                        'about 7.5 mm away from the goal on average')
    sentence, = told(Chain(0.95 * arc(1.5).points))
    assert '5.0 % shorter' in sentence


@pytest.mark.parametrize('options, words', [
    ({'reach_1': 'box -1 -1 -1 0.31 1 1'}, '10 of the 21 points of the goal are outside the reach'),
    ({'reach_1': 'box -1 -1 -1 0.31 1 1', 'reach_2': 'box 0.32 -1 -1 1 1 1', 'hands': 2}, None),
    ({'reach_1': 'annulus 5 5 0 1'}, 'no point of the DLO is within the reach of hand_1, so nothing'),
    ({'no_go': ['0.1 -0.1 -1 0.2 0.05 1']}, 'the DLO is in the no-go box 0.1 -0.1 -1 0.2 0.05 1')])
def test_what_the_limits_prevent_is_told(options, words):
    found = told(laid(FRACTIONS, 0.2), **options)
    assert [text for text in found if words and text.startswith(words)] == list(found[:1])
    assert bool(found) == (words is not None)
