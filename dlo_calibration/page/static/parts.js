// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Parts of the panels of all steps. */

import {h} from './dom.js';

/** Show the last refusal, at its place of the page. */
export function problem(project, place) {
  const refusal = project.problem;
  return h(
    'div',
    {role: 'alert', key: `problem-${place}`},
    refusal && refusal.place === place ? h('p.problem', {}, refusal.text) : null,
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
      choices.map(([name, text]) => h('option', {key: name, value: name}, text)),
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

/** Links to the documents of the board. */
export function boards() {
  return [
    h('a', {href: 'api/board/a4.pdf', download: true}, 'board for A4'),
    ' or ',
    h('a', {href: 'api/board/letter.pdf', download: true}, 'board for Letter'),
    ' (PDF)',
  ];
}

/** A hand at a pixel of the photograph. */
export function hand(key, kind, [u, v]) {
  return h(
    'g.playing',
    {key, class: kind, 'data-u': u, 'data-v': v},
    h('path', {d: 'M-11-26V-8Q-11 0-3 1M11-26V-8Q11 0 3 1M-11-26H11M0-26V-38'}),
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

/** The warnings about a trial that belong to a step, without what is said to be missing; a remedy is a button. */
export function warnings(app, step = null) {
  const listed = (app.project.state.trials[app.trial]?.warnings ?? []).filter(({level, remedy}) =>
    step === null ? level !== 'error' : (app.remedies[remedy]?.step ?? 3) === step && !(level === 'error' && remedy),
  );
  if (!listed.length) return null;
  const names = {error: 'Missing', warning: 'Check', hint: 'Hint'};
  return h(
    'ul.warnings',
    {},
    listed.map((warning) =>
      h(
        'li',
        {class: warning.level},
        h('strong', {}, `${names[warning.level]}: `),
        warning.text,
        app.remedies[warning.remedy] &&
          !(warning.level === 'error' && app.remedies[warning.remedy].step === app.step) &&
          !['add_click', 'check_length', 'more_points'].includes(app.step === 2 ? warning.remedy : '')
          ? h(
              'div',
              {},
              button(app.remedies[warning.remedy].text, () => app.remedies[warning.remedy].act()),
            )
          : null,
      ),
    ),
  );
}
