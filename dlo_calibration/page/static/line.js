// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Lines over the photograph. */

import {h} from './dom.js';

const texts = new WeakMap();

/** @param {Array<[number, number]>} line @returns {string} as an attribute; remembered as long as the line */
export function points(line) {
  let text = texts.get(line);
  if (text === undefined) {
    text = line.map(([u, v]) => `${u.toFixed(2)},${v.toFixed(2)}`).join(' ');
    texts.set(line, text);
  }
  return text;
}

/** A line with a dark edge, so that it is seen on every photograph. */
export function line(pixels, kind, key) {
  return h(
    'g',
    {key, class: `line ${kind}`},
    h('polyline.edge', {points: points(pixels)}),
    h('polyline.core', {points: points(pixels)}),
  );
}

const parts = new WeakMap();

/** Describe a traced line: its sure and its unsure parts. */
export function traced(trace) {
  if (!trace || trace.pixels.length < 2) return [];
  if (!parts.has(trace)) {
    const pieces = [];
    let from = 0;
    for (let i = 1; i <= trace.sure.length; i++) {
      if (i < trace.sure.length && trace.sure[i] === trace.sure[from]) continue;
      const to = Math.min(trace.pixels.length, i + 1);
      pieces.push(
        line(trace.pixels.slice(from, to), trace.sure[from] ? 'sure' : 'unsure', `part${pieces.length}`),
      );
      from = i;
    }
    parts.set(trace, pieces);
  }
  return parts.get(trace);
}
