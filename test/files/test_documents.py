# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The documents say what is declared."""

from pathlib import Path
import re

from fitting import fitted
import pytest

from dlo_calibration.calibration.options import declarations
from dlo_calibration.ros.diagnostics import OUTPUT_TYPES

ROOT = Path(__file__).resolve().parents[2]


def documented():
    """Return the cells of the table of parameters in doc/messages.md, by name."""
    text = (ROOT / 'doc/messages.md').read_text(encoding='utf-8')
    rows = re.findall(r'^\| `(\w+)` \| (.*?) \| (.*?) \| (.*?) \| (.*?) \|$', text, re.MULTILINE)
    return {name: rest for name, *rest in rows}


def test_every_parameter_is_documented_as_it_is_declared():
    table = documented()
    assert list(table) == [declaration.name for declaration in declarations()]
    for declaration in declarations():
        default, unit, values, meaning = table[declaration.name]
        assert (unit, meaning) == (declaration.unit, declaration.description)
        shown = declaration.default
        shown = ', '.join(shown) if isinstance(shown, tuple) else \
            str(shown).lower() if isinstance(shown, bool) else \
            f'{shown:g}' if isinstance(shown, float) else str(shown)
        assert default == shown
        if declaration.choices:
            assert values == ', '.join(declaration.choices)
        elif declaration.minimum is not None:
            assert values == f'{declaration.minimum:g} to {declaration.maximum:g}'


def test_every_topic_is_documented():
    text = (ROOT / 'doc/messages.md').read_text(encoding='utf-8')
    for name in ('initial_chain', 'action', 'goal_chain', *OUTPUT_TYPES, 'start', 'stop', 'reset'):
        assert f'~/{name}' in text


@pytest.mark.parametrize('document', [
    'README.md', 'CONTRIBUTING.md', 'doc/guide.md', 'doc/messages.md', 'doc/formats.md',
    'doc/physics.md', 'doc/report.md', 'doc/experiment.md', 'msg_samples/README.md',
    'benchmark/README.md'])
def test_links_lead_somewhere(document):
    text = (ROOT / document).read_text(encoding='utf-8')
    for target in re.findall(r'\]\(([^)#]+)\)', text):
        if '://' not in target:
            assert ((ROOT / document).parent / target).exists(), target


def test_the_rope_of_the_readme_runs(tmp_path):
    """Execute the three lines of README on a result that was fitted and written."""
    import pybullet

    from dlo_calibration.files.result import read_result, write_result
    from dlo_calibration.files.session import read_session
    from dlo_calibration.model.chain import Chain
    from dlo_calibration.model.parameters import ParameterSpace
    from dlo_calibration.search import LeastSquares
    from dlo_calibration.simulation.bullet import BulletRope, BulletSimulator

    session = read_session(ROOT / 'msg_samples/object1')
    trials = session.trials
    simulator = BulletSimulator()
    result = fitted(trials[:1], ParameterSpace(mass=0.03), simulator, LeastSquares(4, seed=1), budget=1)
    simulator.close()
    write_result(tmp_path / 'result.xml', result)
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    snippet, = (one for one in re.findall('```python\n(.*?)```', text, re.DOTALL) if 'rope.step()' in one)
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    names = {'read_result': read_result, 'BulletRope': BulletRope, 'Chain': Chain, 'client': client,
             'points': trials[0].initial.points + (0, 0, 1)}
    exec(snippet.replace('fitted/result.xml', str(tmp_path / 'result.xml')), names)
    rope = names['rope']
    # There is no table in this world: one step of free fall.
    expected = 9.81 * rope.time_step**2
    pybullet.disconnect(physicsClientId=client)
    assert rope.points[:, 2].mean() == pytest.approx(names['points'][:, 2].mean() - expected, abs=3e-4)
