// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The question at a crossing: which strand is above. */

import {h} from './dom.js';
import {passages} from './geometry.js';
import {line} from './line.js';

const REACH = 3.5; // widths of the DLO that are drawn to each side of a crossing

const strands = new WeakMap();

/** @returns {{first: Array, second: Array}} the pixels of both strands near a crossing */
function strandsOf(trace, crossing) {
  if (!strands.has(crossing)) {
    const {pixels, width} = trace;
    const step = Math.max(1e-6, Math.hypot(pixels[1][0] - pixels[0][0], pixels[1][1] - pixels[0][1]));
    const reach = Math.max(3, Math.round((REACH * width) / step));
    const [first, second] = passages(pixels, crossing.pixel, width).map((i) =>
      pixels.slice(Math.max(0, i - reach), i + reach + 1),
    );
    strands.set(crossing, {first, second});
  }
  return strands.get(crossing);
}

/** Describe a crossing: the upper strand over the lower one, or both in colours while it is asked about. */
export function crossingDrawn(trace, crossing, k, pointed, asked) {
  const {first, second} = strandsOf(trace, crossing);
  const above = pointed === null ? crossing.first_above : pointed === 'first';
  const [low, high] = above
    ? [
        ['second', second],
        ['first', first],
      ]
    : [
        ['first', first],
        ['second', second],
      ];
  const [u, v] = crossing.pixel;
  const label = asked
    ? `Crossing ${k + 1}: which strand is above?`
    : `Crossing ${k + 1}: ${
        crossing.answered
          ? `the ${crossing.first_above ? 'first' : 'second'} strand is above`
          : 'not answered'
      }. Enter asks again.`;
  return h(
    'g',
    {key: `crossing ${k}`},
    asked
      ? [low, high].map(([name, pixels]) =>
          h(
            'g',
            {key: name},
            line(pixels, `strand ${name} ${name === pointed ? 'pointed' : ''}`),
            h(
              'g.letter',
              {'data-u': pixels[0][0], 'data-v': pixels[0][1]},
              h('circle', {r: 10}),
              h('text', {y: 4.5}, name === 'first' ? 'A' : 'B'),
            ),
          ),
        )
      : crossing.answered
        ? line(high[1], 'upper')
        : null,
    h(
      'g.mark.crossing',
      {
        key: 'mark',
        'data-mark': `crossing ${k}`,
        'data-u': u,
        'data-v': v,
        tabindex: 0,
        role: 'button',
        'aria-label': label,
      },
      h('circle.touch', {r: 16}),
      h('circle.ring', {r: 14}),
      asked ? null : h('circle.halo', {r: 11}),
    ),
  );
}

/** Describe the question. */
export function question(step, trace, k) {
  const crossing = trace.crossings[k];
  const answer = (name, text) =>
    h(
      'button',
      {
        type: 'button',
        class: `strand ${name}`,
        key: name,
        onclick: () => step.answer(k, name === 'first'),
        onmouseenter: () => point(step, name),
        onfocus: () => point(step, name),
        onmouseleave: () => point(step, null),
        onblur: () => point(step, null),
      },
      text,
      crossing.suggested === (name === 'first') ? h('small', {}, ' as it looks') : null,
    );
  return h(
    'div.bubble',
    {
      key: `${step.app.id} ${k}`,
      role: 'group',
      'aria-label': `Crossing ${k + 1}`,
      'data-u': crossing.pixel[0],
      'data-v': crossing.pixel[1],
      'data-gap': REACH * trace.width,
    },
    h('p', {}, 'The DLO crosses itself. Which strand is above?'),
    h(
      'div.row',
      {},
      answer('first', 'A (blue)'),
      answer('second', 'B (orange)'),
      h(
        'button.plain',
        {
          type: 'button',
          key: 'later',
          onclick: () => {
            step.later.add(`${step.app.id} ${k}`);
            step.question = null;
            step.app.refresh();
          },
        },
        'Later',
      ),
    ),
  );
}

function point(step, name) {
  step.strand = name;
  step.app.refresh();
}
