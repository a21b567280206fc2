// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The fields of a movement of the hands. */

import {h} from './dom.js';
import {HANDS, spoken} from './hand_names.js';
import {button, choice, numeric, tick} from './parts.js';
import {pictures} from './pictures.js';

const WORDS = {
  height: 'Height of the lift',
  speed: 'Speed of the hand',
  distance: 'Distance',
  hold: 'The hand still holds the DLO in the goal photograph',
  motion: 'The hands move',
  moving: 'Which hand moves',
  fraction: 'Gripped point',
  together: 'together',
  apart: 'apart',
  both: 'both',
  first: 'the first',
  second: 'the second',
};
const UNITS = {m: ['mm', 1e3], 'm/s': ['mm/s', 1e3], s: ['s', 1], '': ['', 1]};
const SHARE = {unit: '% of the length', factor: 100};

/**
 * Describe a movement, with its fields where it is chosen.
 *
 * @param {import('./hands.js').HandsStep} owner
 * @param {object} step of the document
 * @param {number} k its number in the trial
 * @param {boolean} open
 */
export function stepCard(owner, step, k, open) {
  const {title, text, fields} = owner.kind(step.kind);
  const choose = () => {
    owner.chosen = k;
    owner.app.refresh();
  };
  return h(
    'section.stepcard',
    {class: open ? 'open' : null, 'aria-label': `Movement ${k + 1}: ${title}`},
    h(
      'div.head',
      {},
      pictures[step.kind]?.() ?? null,
      h(
        'button.plain',
        {type: 'button', 'aria-expanded': String(open), onclick: choose},
        h('strong', {}, `${k + 1} ${title}`),
      ),
      button(
        '✕',
        () =>
          owner.change(k, (removed, steps) => {
            steps.splice(k, 1);
          }),
        {'aria-label': `Remove movement ${k + 1}`, class: 'plain'},
      ),
    ),
    open
      ? h(
          'div.group',
          {},
          h('p.note', {}, text),
          k
            ? tick({
                label: 'It begins together with the movement before',
                checked: step.with_previous,
                key: 'with',
                onset: (value) =>
                  owner.change(k, (changed) => {
                    changed.with_previous = value;
                  }),
              })
            : null,
          Object.entries(fields).map(([name, field]) => described(owner, step, k, name, field)),
        )
      : null,
  );
}

function described(owner, step, k, name, field) {
  const set = (value, merge) =>
    owner.change(
      k,
      (changed) => {
        changed[name] = value;
      },
      merge,
    );
  const value = step[name];
  const {minimum, maximum} = field;
  switch (field.form) {
    case 'name':
      return named('Hand', value, set, name);
    case 'names':
      return value.map((hand, i) =>
        named(
          value.length > 1 ? `Hand ${i + 1}` : 'Hand',
          hand,
          (chosen) => set(value.map((other, j) => (j === i ? chosen : other))),
          `${name}${i}`,
        ),
      );
    case 'numbers':
      return value.map((fraction, i) =>
        numeric({
          ...SHARE,
          label: `Point that hand ${i + 1} grips`,
          value: fraction,
          minimum,
          maximum,
          key: `${name}${i}`,
          onset: (typed) => set(value.map((other, j) => (j === i ? typed : other))),
        }),
      );
    case 'truth':
      return name === 'hold' && 'to' in step
        ? null
        : tick({label: WORDS[name] ?? name, checked: value, key: name, onset: set});
    case 'choice':
      return choice({
        label: WORDS[name] ?? name,
        value,
        choices: field.choices.map((option) => [option, WORDS[option] ?? option]),
        key: name,
        onset: set,
      });
    case 'place':
      return place(owner, step, k, name);
    case 'waypoints':
      return waypoints(owner, value, set, name);
    default: {
      const [unit, factor] = UNITS[field.unit] ?? [field.unit, 1];
      return numeric({
        label: WORDS[name] ?? name,
        value,
        minimum,
        maximum,
        key: name,
        onset: set,
        ...(name === 'fraction' ? SHARE : {unit, factor}),
      });
    }
  }
}

function named(label, value, set, key) {
  const names = HANDS.includes(value) ? HANDS : [...HANDS, value];
  return choice({label, value, choices: names.map((name) => [name, spoken(name)]), onset: set, key});
}

/** Ask where the hand was in the goal photograph, on which the meaning of the goal depends. */
function place(owner, step, k, key) {
  const now = step.hold ? 'hold' : step.to ? 'to' : 'there';
  const option = (value, text, act) =>
    h(
      'label.tick',
      {key: value},
      h('input', {type: 'radio', name: `opened${k}`, value, checked: now === value, onchange: act}),
      h('span', {}, text),
    );
  const free = (hold) => () => owner.change(k, (other) => Object.assign(other, {hold, to: null}));
  return h(
    'fieldset',
    {key},
    h('legend', {}, 'At the goal, the hand …'),
    option('hold', 'still holds the DLO', free(true)),
    option(
      'to',
      step.to
        ? `opened at the marked place (x = ${shown(step.to[0])}, y = ${shown(step.to[1])})`
        : 'opened at a place that I mark',
      () => {
        owner.change(k, (other) => {
          other.hold = false;
        });
        owner.chosen = k;
        owner.markPlace();
      },
    ),
    option('there', 'opened, and the point stayed there', free(false)),
  );
}

const shown = (metres) => `${(1e3 * metres).toFixed(0)} mm`;

function waypoints(owner, value, set, key) {
  return h(
    'div',
    {key},
    h(
      'p.note',
      {},
      owner.clicks()
        ? 'Click the places that the hand passed, in their order. A height above 0 lifts the point.'
        : 'Draw the path in the start photograph.',
    ),
    value.length
      ? h(
          'table.points',
          {},
          h(
            'thead',
            {},
            h(
              'tr',
              {},
              ['place', 'height [mm]', 'remove'].map((text) => h('th', {scope: 'col'}, text)),
            ),
          ),
          h(
            'tbody',
            {},
            value.map((waypoint, i) =>
              h(
                'tr',
                {key: i},
                h('th', {scope: 'row'}, String(i + 1)),
                h(
                  'td',
                  {},
                  numeric({
                    label: `Height of place ${i + 1} in mm`,
                    value: waypoint[2],
                    factor: 1e3,
                    minimum: 0,
                    maximum: 5,
                    short: true,
                    onset: (height) =>
                      set(value.map((other, j) => (j === i ? [other[0], other[1], height] : other))),
                  }),
                ),
                h(
                  'td',
                  {},
                  button('✕', () => set(value.filter((other, j) => j !== i)), {
                    'aria-label': `Remove place ${i + 1}`,
                  }),
                ),
              ),
            ),
          ),
        )
      : null,
  );
}
