# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The documents say what is declared."""

from dataclasses import replace
from pathlib import Path
import re

import pytest

from dlo_calibration.calibration.options import declarations
from dlo_calibration.files.intake import OUTPUT_TYPES

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
    'README.md', 'CONTRIBUTING.md', 'doc/capture.md', 'doc/guide.md', 'doc/messages.md', 'doc/formats.md',
    'doc/physics.md', 'doc/report.md', 'doc/experiment.md', 'msg_samples/README.md',
    'msg_samples/photographs/README.md', 'benchmark/README.md'])
def test_links_lead_somewhere(document):
    text = (ROOT / document).read_text(encoding='utf-8')
    for target in re.findall(r'\]\(([^)#]+)\)', text):
        if '://' not in target:
            assert ((ROOT / document).parent / target).exists(), target


def test_the_snippets_of_the_readme_work(tmp_path, capsys):
    """Execute them one after the other, on a sample and with fewer evaluations."""
    import pybullet

    from dlo_calibration.files.result import write_result

    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    sample, few = str(ROOT / 'msg_samples/object1'), "evaluations=2, nodes=12, workers=1, engine='compiled'"
    for written, tried in (('dlo_session_20260101_120000', sample), ('another_session', sample),
                           ('mass=0.03', f'mass=0.03, {few}'),
                           ('session.options)', f'replace(session.options, {few}))'),
                           ('fitted/result.xml', str(tmp_path / 'result.xml'))):
        assert written in text
        text = text.replace(written, tried)
    one, several, world = re.findall('```python\n(.*?)```', text, re.DOTALL)
    names = {'replace': replace}
    exec(one, names)
    assert capsys.readouterr().out.count('flexibility') == 1
    exec(several, names)
    assert len(names['result'].trials) == 2 * len(names['session'].trials)
    write_result(tmp_path / 'result.xml', names['result'])
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    points = names['session'].trials[0].initial.points + (0, 0, 1)
    names.update(client=client, points=points)
    exec(world, names)
    pybullet.disconnect(physicsClientId=client)
    # There is no table in this world: one step of free fall.
    rope = names['rope']
    expected = points[:, 2].mean() - 9.81 * rope.time_step**2
    assert rope.points[:, 2].mean() == pytest.approx(expected, abs=3e-4)
