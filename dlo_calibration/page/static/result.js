// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The result of a calibration: table, sentences, files. */

import {h} from './dom.js';
import {button, problem} from './parts.js';
import {interval, isComponent, measured, millimetres, number, words} from './words.js';

const MARKS = {identifiable: 'good', 'weakly identifiable': 'weak', 'not identifiable': 'bad'};
const FILES = {
  'report.html': 'Report',
  'result.xml': 'Result (XML)',
  'session.mcap': 'Session (MCAP)',
  'request.xml': 'Request (XML)',
  'evaluations.csv': 'All tried parameter sets (CSV)',
};
const BEFORE = ['session.mcap', 'request.xml']; // are there without a result

/** Describe the result. */
export function resultPanel(step, calibration) {
  const {result, warnings} = calibration;
  const texts = [...new Set([...(warnings ?? []), ...(result.warnings ?? [])])];
  return h(
    'section',
    {key: 'result', 'aria-label': 'Result'},
    h('h3', {}, 'Result', calibration.state === 'stopped' ? ' (stopped before its end)' : ''),
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
            .map(([name, one]) => parameter(name, one)),
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
      `Simulated and measured points lie ${millimetres(result.mean_error_m, 1)} apart on average. `,
      'Watch the film below the photograph: the simulated DLO over your photograph.',
    ),
    files(step.app, calibration),
    sending(step),
  );
}

function parameter(name, one) {
  const verdict = one.verdict || (one.identifiable ? 'identifiable' : 'not identifiable');
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
      h('strong', {}, measured(one.physical_value, one.physical_unit)),
      h('br'),
      interval(one.physical_lower, one.physical_upper, one.physical_unit),
      bar(one),
      h(
        'small',
        {},
        `${number(one.value)} (${number(one.lower)} to ${number(one.upper)}) on the scale from 0 to 100`,
      ),
      one.note ? h('small', {}, h('br'), one.note) : null,
    ),
  );
}

function bar({value, lower, upper}) {
  return h(
    'svg',
    {class: 'bar', viewBox: '0 0 100 10', preserveAspectRatio: 'none', 'aria-hidden': 'true'},
    h('rect.whole', {x: 0, y: 3, width: 100, height: 4}),
    lower === null || upper === null
      ? null
      : h('rect.interval', {x: lower, y: 3, width: Math.max(1, upper - lower), height: 4}),
    h('rect.value', {x: Math.min(98, Math.max(0, value - 1)), y: 0, width: 2, height: 10}),
  );
}

function files(app, calibration) {
  const there = calibration.files ?? Object.keys(FILES);
  const chains = app.used().filter(([, , id]) => app.project.seen(id)?.trace?.length);
  return h(
    'details',
    {open: true, key: 'files'},
    h('summary', {}, 'Save'),
    h(
      'ul.files',
      {},
      Object.entries(FILES)
        .filter(([name]) => there.includes(name) || BEFORE.includes(name))
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
