// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Parts of the panels of all steps. */

import {h} from './dom.js';

/** Show what was refused at a place of the page. */
export function problem(project, place) {
  const one = project.problem;
  return h(
    'div',
    {role: 'alert', key: `problem-${place}`},
    one && one.place === place ? h('p.problem', {}, one.text) : null,
  );
}

/** A field for a number, in SI units inside and in a handier unit on the page. */
export function numeric({
  label,
  value,
  unit = '',
  factor = 1,
  minimum,
  maximum,
  step = 'any',
  optional = false,
  placeholder,
  key,
  onset,
  short = false,
}) {
  const shown = value === null || value === undefined ? '' : String(Number((value * factor).toPrecision(6)));
  const change = (event) => {
    const {target} = event;
    const typed = target.value.trim();
    if (typed === '' ? !optional : !target.checkValidity()) {
      if (typed === '') target.value = shown;
      else target.reportValidity();
      return;
    }
    onset(typed === '' ? null : Number(typed) / factor);
  };
  return h(
    'label.field',
    {key, class: short ? 'short' : null},
    h(
      'span',
      {class: short ? 'unseen' : null},
      label,
      unit && !short ? h('span.unit', {}, ` [${unit}]`) : null,
    ),
    h('input', {
      type: 'number',
      value: shown,
      min: minimum === undefined ? null : minimum * factor,
      max: maximum === undefined ? null : maximum * factor,
      step,
      placeholder,
      inputmode: 'decimal',
      onchange: change,
    }),
  );
}

/** A field with choices: [value, text] each. */
export function choice({label, value, choices, onset, key, tall = false}) {
  return h(
    'label.field',
    {key, class: tall ? 'tall' : null},
    h('span', {}, label),
    h(
      'select',
      {value, onchange: (event) => onset(event.target.value)},
      choices.map(([one, text]) => h('option', {key: one, value: one}, text)),
    ),
  );
}

/** A box to be ticked. */
export function tick({label, checked, onset, key}) {
  return h(
    'label.tick',
    {key},
    h('input', {type: 'checkbox', checked, onchange: (event) => onset(event.target.checked)}),
    h('span', {}, label),
  );
}

/** @param {string} text @param {Function} onclick @param {object} more attributes */
export function button(text, onclick, more = {}) {
  return h('button', {type: 'button', onclick, ...more}, text);
}

/** A button for files; it opens the chooser of the system. */
export function files({text, accept, multiple = false, folder = false, onfiles, primary = false, key}) {
  return h(
    'label.file',
    {key, class: primary ? 'primary' : null},
    h('input.unseen', {
      type: 'file',
      accept,
      multiple,
      webkitdirectory: folder,
      onchange: (event) => {
        const chosen = [...event.target.files];
        event.target.value = '';
        if (chosen.length) onfiles(chosen);
      },
    }),
    h('span', {}, text),
  );
}

/**
 * A mark on the photograph, which can be dragged, and moved by keys.
 *
 * @param {{name: string, at: [number, number], label: string, kind: string, text?: string}} given
 */
export function mark({name, at, label, kind, text}) {
  return h(
    'g.mark',
    {
      key: name,
      class: kind,
      'data-mark': name,
      'data-u': at[0],
      'data-v': at[1],
      tabindex: 0,
      role: 'button',
      'aria-label': label,
    },
    h('circle.touch', {r: 16}),
    h('circle.ring', {r: 12}),
    h('circle.dot', {r: 6.5}),
    text ? h('text', {x: 11, y: -9}, text) : null,
  );
}

/** What the lines and marks of a step mean: [kind, words] each. */
export function legend(entries) {
  return h(
    'ul.meanings',
    {'aria-label': 'Meaning of the lines and marks'},
    entries.map(([kind, text]) =>
      h(
        'li',
        {},
        h(
          'svg',
          {class: 'sample', viewBox: '0 0 34 14', 'aria-hidden': 'true'},
          kind.startsWith('mark')
            ? h('g', {class: kind, transform: 'translate(17 7)'}, h('circle.dot', {r: 5.5}))
            : h('g', {class: `line ${kind}`}, h('path.edge', {d: 'M3 7H31'}), h('path.core', {d: 'M3 7H31'})),
        ),
        h('span', {}, text),
      ),
    ),
  );
}

/** The warnings about a trial that belong to a step; a remedy is a button. */
export function warnings(app, step = null) {
  const listed = (app.project.state.trials[app.trial]?.remarks ?? []).filter(
    (one) => step === null || (app.remedies[one.remedy]?.step ?? 3) === step,
  );
  if (!listed.length) return null;
  const names = {error: 'Missing', warning: 'Check', hint: 'Hint'};
  return h(
    'ul.warnings',
    {},
    listed.map((one) =>
      h(
        'li',
        {class: one.level},
        h('strong', {}, `${names[one.level]}: `),
        one.text,
        app.remedies[one.remedy] &&
          !(one.level === 'error' && app.remedies[one.remedy].step === app.step) &&
          !['add_click', 'check_length', 'more_points'].includes(app.step === 2 ? one.remedy : '')
          ? h(
              'div',
              {},
              button(app.remedies[one.remedy].text, () => app.remedies[one.remedy].act()),
            )
          : null,
      ),
    ),
  );
}
