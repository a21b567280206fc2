# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Every Python snippet of the documents works, with the imports that stand in it."""

from dataclasses import replace
from itertools import chain
from pathlib import Path
import re
from types import FunctionType, ModuleType, SimpleNamespace

import numpy as np
import pytest

from dlo_calibration import export_usd, Options, read_result
from dlo_calibration.files.chain_file import read_chain_file

ROOT = Path(__file__).resolve().parents[2]
DLO = str(ROOT / 'msg_samples/xml/dlo.xml')


def snippets(document):
    """Return the Python snippets of a document."""
    return re.findall('```python\n(.*?)```', (ROOT / document).read_text(encoding='utf-8'), re.DOTALL)


def performed(snippet, names, written):
    """
    Execute a snippet; what it imports is not known to the next one.

    :param names: that earlier snippets have left, or that the reader has.
    :param written: what is replaced in it: folders, files and lengths of searches.
    """
    for text, other in written.items():
        assert text in snippet
        snippet = snippet.replace(text, other)
    exec(snippet, names)
    for name, value in list(names.items()):
        if isinstance(value, (FunctionType, ModuleType, type)):
            del names[name]


def test_every_document_with_snippets_is_tried_here():
    documents = chain(ROOT.glob('*.md'), *(ROOT.glob(f'{folder}/**/*.md') for folder in (
        'benchmark', 'doc', 'examples', 'msg_samples')))
    documents = {str(file.relative_to(ROOT)) for file in documents if snippets(file)}
    assert documents == {'doc/export.md', 'doc/guide.md', 'doc/planning.md'}


def test_the_snippets_about_calibration_work(capsys):
    sample, few = str(ROOT / 'msg_samples/object1'), "evaluations=2, nodes=12, workers=1, engine='compiled'"
    single, several = snippets('doc/guide.md')[1:3]
    names = {}
    performed(single, names,
              written={'dlo_session_20260101_120000': sample, 'mass=0.03': f'mass=0.03, {few}'})
    assert capsys.readouterr().out.count('flexibility') == 1
    read = names['session']
    names['session'] = SimpleNamespace(trials=read.trials, options=replace(
        read.options, evaluations=2, nodes=12, workers=1, engine='compiled'))
    performed(several, names, written={'another_session': sample})
    assert len(names['result'].trials) == 2 * len(names['session'].trials)


def test_the_snippet_about_actions_works():
    clock = pytest.importorskip('rclpy.clock')
    names = {'node': SimpleNamespace(get_clock=clock.Clock)}
    performed(snippets('doc/guide.md')[0], names, written={})
    assert [point.transforms[0].translation.z for point in names['action'].points] == [0.004, 0.1]


@pytest.mark.pybullet
def test_the_snippet_about_a_robot_that_holds_a_rope_works():
    import pybullet

    names = {}
    performed(snippets('doc/guide.md')[3], names, written={
        'result.xml': DLO})
    pybullet.disconnect(physicsClientId=names['client'])
    # It hung from the gripper, and was let go at last: the other end has fallen.
    points = names['rope'].points
    np.testing.assert_allclose(points[0], names['begin'], atol=0.02)
    assert points[-1, 2] < points[0, 2] - 0.3


def test_the_snippet_about_planning_works(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    names = {}
    snippet, = snippets('doc/planning.md')
    performed(snippet, names, written={
        "'result.xml'": repr(DLO), 'actions=3': 'actions=1, draws=0, workers=1'})
    assert capsys.readouterr().out.startswith('False')  # one action is not enough
    planned, = names['planned'].actions
    np.testing.assert_allclose(names['prediction'].steps[-1].chain, planned.predicted, atol=1e-3)


def test_the_snippet_for_newton_works(tmp_path, monkeypatch):
    newton = pytest.importorskip('newton', '1.8', reason='needs newton 1.8 and usd-core')
    pytest.importorskip('pxr', reason='needs newton 1.8 and usd-core')
    assert newton is not None
    chain = read_chain_file(ROOT / 'msg_samples/chains/start.csv')
    (tmp_path / 'dlo.usda').write_text(export_usd(read_result(DLO), chain, options=Options(nodes=21)))
    monkeypatch.chdir(tmp_path)
    snippet, = snippets('doc/export.md')
    names = {}
    performed(snippet, names, written={'range(2000)': 'range(2)'})
    assert np.isfinite(names['now'].body_q.numpy()).all()
