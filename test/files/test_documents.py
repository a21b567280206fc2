# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The documents say what is declared."""

import argparse
from pathlib import Path
import re

from made_up_dlo import made_up_plan
import pytest
from toy_planner import PlannerGraph, ToyPlan

from dlo_calibration.calibration.options import Options
from dlo_calibration.cli import main
from dlo_calibration.cli.arguments import PREFIX
from dlo_calibration.files.result import read_result
from dlo_calibration.messages.codec import OUTPUT_TYPES
from dlo_calibration.planning.plan import plain_plan
from dlo_calibration.ros import planner_session
from dlo_calibration.ros.planner_session import PlannerOptions

ROOT = Path(__file__).resolve().parents[2]


def headings(path):
    """Return the headings of a document, as links name them."""
    found = re.findall('^#+ (.*)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w -]', '', one).lower().replace(' ', '-') for one in found}


def sections():
    """Return the sections of doc/messages.md by their headings."""
    text = (ROOT / 'doc/messages.md').read_text(encoding='utf-8')
    return dict(part.split('\n', 1) for part in text.split('\n## ')[1:])


@pytest.mark.parametrize('heading, declared', [
    ('Parameters', Options.declarations()), ('The planner', PlannerOptions.declarations())],
    ids=['calibrator', 'planner'])
def test_every_parameter_is_documented_as_it_is_declared(heading, declared):
    row = re.compile(r'^\| `(\w+)` \| (.*?) \| (.*?) \| (.*?) \| (.*?) \|$', re.MULTILINE)
    table = {name: rest for name, *rest in row.findall(sections()[heading])}
    assert list(table) == [declaration.name for declaration in declared]
    for declaration in declared:
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
    planner = sections()['The planner']
    for name in (*planner_session.INPUT_TYPES, *planner_session.OUTPUT_TYPES, 'plan', 'stop'):
        assert f'~/{name}' in planner
    calibrator = ''.join(text for heading, text in sections().items() if heading != 'The planner')
    for name in ('initial_chain', 'action', 'goal_chain', *OUTPUT_TYPES,
                 'start', 'stop', 'reset', 'discard_last'):
        assert f'~/{name}' in calibrator


def test_every_verb_is_documented_with_its_own_flags():
    text = (ROOT / 'doc/commands.md').read_text(encoding='utf-8')
    first, common, *verbs = text.split('\n## ')
    told = {text.partition('\n')[0]: text for text in verbs}
    assert set(told) == set(main.VERBS) == set(re.findall('^\\| \\[`(.*?)`\\]', first, re.MULTILINE))
    for verb in main.VERBS:
        parser = argparse.ArgumentParser(add_help=False)
        main.module_of(verb).add_arguments(parser)
        for flag in (action for action in parser._actions if not action.dest.startswith(PREFIX)):
            for word in flag.option_strings or [flag.metavar]:
                assert word in f'{told[verb]}{common}', f'{verb} {word}'


def test_every_key_of_the_planners_status_is_documented(monkeypatch):
    monkeypatch.setattr(planner_session, 'plan', ToyPlan())
    graph = PlannerGraph()
    try:
        graph.send_chains()
        keys = set(graph.planned())
    finally:
        graph.session.close()
    assert {'state', 'missing', 'reached'} <= keys
    for key in keys:
        assert f'`{key}`' in sections()['The planner']


def test_every_key_of_a_plan_is_documented():
    plan = plain_plan(made_up_plan(read_result(ROOT / 'msg_samples/xml/dlo.xml').chain))
    for key in (*plan, *plan['actions'][0], *plan['actions'][0]['hands'][0]):
        assert f'`{key}`' in sections()['JSON']


@pytest.mark.parametrize('document', [
    'README.md', 'CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'doc/capture.md', 'doc/commands.md',
    'doc/guide.md', 'doc/messages.md', 'doc/formats.md', 'doc/physics.md', 'doc/planning.md', 'doc/report.md',
    'doc/experiment.md', 'msg_samples/README.md', 'msg_samples/photographs/README.md', 'benchmark/README.md'])
def test_links_lead_somewhere(document):
    text = (ROOT / document).read_text(encoding='utf-8')
    for target, heading in re.findall(r'\]\(([^)#]*)#?([^)]*)\)', text):
        if '://' not in target:
            path = (ROOT / document).parent / target if target else ROOT / document
            assert path.exists(), target
            assert not heading or heading in headings(path), f'{target}#{heading}'
