// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The result of a calibration: table, sentences, files. */

import {h} from './dom.js';
import {button, problem} from './parts.js';
import {interval, isComponent, measured, number, words} from './words.js';

const MARKS = {identifiable: 'good', 'weakly identifiable': 'weak', 'not identifiable': 'bad'};
const SCENE = 'obstacles.urdf';
const FILES = {
  'report.html': 'Report',
  'result.xml': 'Result (XML)',
  'session.mcap': 'Session (MCAP)',
  'request.xml': 'Request (XML)',
  [SCENE]: 'Obstacles (URDF), which session and request name',
  'evaluations.csv': 'All tried parameter sets (CSV)',
};
const LEAST = 4; // width of the interval on its bar, of 100, so that the mark of the value never hides it
const BEFORE = ['session.mcap', 'request.xml']; // are there without a result

/** Describe the result. */
export function resultPanel(step, calibration) {
  const {result, warnings} = calibration;
  const texts = [...new Set([...(warnings ?? []), ...(result.warnings ?? [])])].filter(
    (text) => text !== result.unusable, // the headline says it
  );
  return h(
    'section',
    {key: 'result', 'aria-label': 'Result'},
    h('h3', {}, 'Result', calibration.state === 'stopped' ? ' (stopped before its end)' : ''),
    result.headline
      ? h('p.headline', {class: result.unusable ? 'bad' : 'good'}, result.headline)
      : null,
    h(
      'div.scroll',
      {tabindex: 0, role: 'region', 'aria-label': 'Parameters'},
      h(
        'table.result',
        {},
        h(
          'thead',
          {},
          h(
            'tr',
            {},
            ['Parameter', 'Value, and interval that holds it with 90 % probability'].map((text) =>
              h('th', {scope: 'col'}, text),
            ),
          ),
        ),
        h(
          'tbody',
          {},
          Object.entries(result.parameters)
            .filter(([name]) => !isComponent(name))
            .map(([name, estimate]) => parameterRow(name, estimate)),
        ),
      ),
    ),
    texts.length
      ? h(
          'ul.warnings',
          {},
          texts.map((text) => h('li.warning', {}, text)),
        )
      : null,
    h(
      'ul.sentences',
      {},
      result.sentences.map((text) => h('li', {}, text)),
    ),
    h(
      'p',
      {},
      'Watch the film below the photograph: the simulated DLO over your photograph.',
    ),
    files(step.app, calibration),
    sending(step),
  );
}

function parameterRow(name, estimate) {
  const verdict = estimate.verdict || (estimate.identifiable ? 'identifiable' : 'not identifiable');
  return h(
    'tr',
    {key: name},
    h(
      'th',
      {scope: 'row'},
      words(name),
      h('br'),
      h('span.verdict', {class: MARKS[verdict] ?? 'weak'}, verdict),
    ),
    h(
      'td',
      {},
      h('strong', {}, measured(estimate.physical_value, estimate.physical_unit, estimate.physical_upper)),
      h('br'),
      interval(estimate.physical_lower, estimate.physical_upper, estimate.physical_unit),
      bar(estimate),
      h(
        'small',
        {},
        `${number(estimate.value)} (${interval(estimate.lower, estimate.upper, '1')})`,
        ' on the scale from 0 to 100',
      ),
      estimate.note ? h('small', {}, h('br'), estimate.note) : null,
    ),
  );
}

function bar({value, lower, upper}) {
  const width = Math.max(LEAST, upper - lower);
  const left = Math.min(100 - width, Math.max(0, (lower + upper - width) / 2));
  return h(
    'svg',
    {class: 'bar', viewBox: '0 0 100 10', preserveAspectRatio: 'none', 'aria-hidden': 'true'},
    h('rect.whole', {x: 0, y: 3, width: 100, height: 4}),
    lower === null || upper === null
      ? null
      : h('rect.interval', {x: left, y: 1, width, height: 8}),
    h('rect.value', {x: Math.min(99, Math.max(0, value - 0.5)), y: 0, width: 1, height: 10}),
  );
}

function files(app, calibration) {
  const there = calibration.files ?? Object.keys(FILES);
  const {obstacles} = app.project.document;
  const chains = app.used().filter(([, , id]) => app.project.seen(id)?.trace?.length);
  return h(
    'details',
    {open: true, key: 'files'},
    h('summary', {}, 'Save'),
    h(
      'ul.files',
      {},
      Object.entries(FILES)
        .filter(([name]) => [...there, ...BEFORE].includes(name) || (name === SCENE && obstacles.length))
        .map(([name, text]) =>
          h(
            'li',
            {key: name},
            h(
              'a',
              name === 'report.html'
                ? {href: `api/files/${name}`, target: '_blank', rel: 'noopener'}
                : {href: `api/files/${name}`, download: true},
              text,
            ),
          ),
        ),
      chains.map(([k, role, id]) =>
        h(
          'li',
          {key: id},
          `Point chain of the ${app.placed(k, role)}: `,
          h(
            'a',
            {
              href: `api/files/${id}.xml`,
              download: true,
              'aria-label': `XML point chain of the ${app.placed(k, role)}`,
            },
            'XML',
          ),
          ', ',
          h(
            'a',
            {
              href: `api/files/${id}.csv`,
              download: true,
              'aria-label': `CSV point chain of the ${app.placed(k, role)}`,
            },
            'CSV',
          ),
        ),
      ),
    ),
  );
}

function sending(step) {
  const {app} = step;
  if (!app.project.state.ros) return null;
  return h(
    'details',
    {key: 'send'},
    h('summary', {}, 'Send the trials to a running calibrator node'),
    h(
      'label.field',
      {},
      h('span', {}, 'Its name in the ROS graph'),
      h('input', {
        type: 'text',
        value: step.namespace,
        spellcheck: 'false',
        onchange: (event) => {
          step.namespace = event.target.value;
        },
      }),
    ),
    button('Send', async () => {
      const answer = await app.project.ask('send', {body: {namespace: step.namespace}, place: 'send'});
      step.sent = answer?.text ?? null;
      app.refresh();
    }),
    h('p', {role: 'status'}, step.sent ?? ''),
    problem(app.project, 'send'),
  );
}
