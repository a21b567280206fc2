# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The documents say what is declared."""

import argparse
from pathlib import Path
import re
import shlex

from made_up_dlo import made_up_plan
import pytest
from toy_planner import PlannerGraph, ToyPlan

from dlo_calibration.calibration.options import Options
from dlo_calibration.cli import main
from dlo_calibration.cli.arguments import PREFIX
from dlo_calibration.files.result import read_result
from dlo_calibration.messages.codec import OUTPUT_TYPES
from dlo_calibration.planning.options import HandOptions
from dlo_calibration.planning.plan import plain_plan
from dlo_calibration.ros import planner_session, tracker_session
from dlo_calibration.ros.planner_session import PlannerOptions
from dlo_calibration.ros.session import CalibratorOptions
from dlo_calibration.ros.tracker_session import TrackerOptions

ROOT = Path(__file__).resolve().parents[2]


def headings(path):
    """Return the headings of a document, as links name them."""
    titles = re.findall('^#+ (.*)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w -]', '', title).lower().replace(' ', '-') for title in titles}


def sections():
    """Return the sections of doc/messages.md by their headings."""
    text = (ROOT / 'doc/messages.md').read_text(encoding='utf-8')
    return dict(part.split('\n', 1) for part in text.split('\n## ')[1:])


#: The limits of the hands are documented once, with the planner.
OF_ADVICE = tuple(declaration for declaration in CalibratorOptions.declarations()
                  if declaration not in (*Options.declarations(), *HandOptions.declarations()))


@pytest.mark.parametrize('heading, declared', [
    ('Parameters', Options.declarations()), ('Advice', OF_ADVICE),
    ('The planner', PlannerOptions.declarations()),
    ('The tracker', TrackerOptions.declarations())], ids=['calibrator', 'advice', 'planner', 'tracker'])
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
    tracker = sections()['The tracker']
    for name in (*tracker_session.INPUT_TYPES, *tracker_session.OUTPUT_TYPES, 'start', 'stop'):
        assert f'~/{name}' in tracker
    calibrator = ''.join(text for heading, text in sections().items()
                         if heading not in ('The planner', 'The tracker'))
    for name in ('initial_chain', 'action', 'goal_chain', 'wrench', *OUTPUT_TYPES,
                 'start', 'stop', 'reset', 'discard_last'):
        assert f'~/{name}' in calibrator


def test_every_verb_is_documented_with_its_own_flags():
    text = (ROOT / 'doc/commands.md').read_text(encoding='utf-8')
    first, common, *verbs = text.split('\n## ')
    verb_texts = {text.partition('\n')[0]: text for text in verbs}
    assert set(verb_texts) == set(main.VERBS) == set(re.findall('^\\| \\[`(.*?)`\\]', first, re.MULTILINE))
    for verb in main.VERBS:
        parser = argparse.ArgumentParser(add_help=False)
        main.module_of(verb).add_arguments(parser)
        for flag in (action for action in parser._actions if not action.dest.startswith(PREFIX)):
            for word in flag.option_strings or [flag.metavar]:
                assert word in f'{verb_texts[verb]}{common}', f'{verb} {word}'


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
    path.relative_to(ROOT).as_posix() for folder in ('', 'benchmark/', 'doc/', 'msg_samples/**/')
    for path in sorted(ROOT.glob(f'{folder}*.md'))])
def test_links_lead_somewhere(document):
    text = (ROOT / document).read_text(encoding='utf-8')
    for target, heading in re.findall(r'\]\(([^)#]*)#?([^)]*)\)', text):
        if '://' not in target:
            path = (ROOT / document).parent / target if target else ROOT / document
            assert path.exists(), target
            assert not heading or heading in headings(path), f'{target}#{heading}'


def indented(document):
    """Return the indented paragraphs of a document, each in one line."""
    paragraphs = re.findall(r'(?:^ {4}.*\n)+', (ROOT / document).read_text(encoding='utf-8'), re.MULTILINE)
    return [' '.join(paragraph.replace('\\\n', ' ').split()) for paragraph in paragraphs]


def split(text):
    """Return a text in one line with # for each number, and the numbers."""
    line, number = ' '.join(text.split()), r'\d+(?:\.\d+)?'
    return re.sub(number, '#', line), [float(value) for value in re.findall(number, line)]


@pytest.mark.long
@pytest.mark.pybullet
@pytest.mark.parametrize('document, count', [('README.md', 1), ('doc/planning.md', 4)])
def test_commands_print_what_the_documents_show(document, count, tmp_path, monkeypatch, capsys):
    """Words are the same; numbers may differ by 2 %, as libraries round differently."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'msg_samples').symlink_to(ROOT / 'msg_samples')
    paragraphs = indented(document)
    shown = [(re.search(r'dlo-calibration (\w+ msg_samples.*)', command), output)
             for command, output in zip(paragraphs, paragraphs[1:], strict=False)]
    commands = [(match[1], output) for match, output in shown if match]
    assert len(commands) == count
    for command, output in commands:
        assert main.main(shlex.split(command)) == 0
        words, numbers = split(capsys.readouterr().out)
        for part in output.split(' ... '):
            expected, values = split(part)
            assert expected in words
            first = words[:words.index(expected)].count('#')
            assert numbers[first:first + len(values)] == pytest.approx(values, rel=0.02)
