// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Known points: pixels of a photograph, and where they lie on the table. */

import {h} from './dom.js';
import {button, choice, mark, numeric} from './parts.js';

export const PLACE = 'scale'; // where a refusal is shown
const SHEETS = {own: null, a4: [0.297, 0.21], letter: [0.2794, 0.2159]}; // m, ISO 216 and ANSI Y14.1

export class KnownPoints {
  #drafts = new Map(); // photograph -> points without a place yet: {pixel, table}
  #sheet = 'own';

  constructor(app) {
    this.app = app;
  }

  /** Describe the fields. */
  panel(photograph, seen) {
    const {points} = photograph.scale;
    const drafts = this.#drafts.get(photograph.id) ?? [];
    return h(
      'div.group',
      {key: 'points'},
      choice({
        label: 'The points are',
        value: this.#sheet,
        key: 'sheet',
        tall: true,
        choices: [
          ['own', 'others, whose places I type'],
          ['a4', 'the corners of an A4 sheet'],
          ['letter', 'the corners of a Letter sheet'],
        ],
        onset: (sheet) => {
          this.#sheet = sheet;
          this.app.refresh();
        },
      }),
      h(
        'p.note',
        {},
        this.#sheet === 'own'
          ? 'Click each point in the photograph, then type its place on the table: x and y in mm, as on a map, from any origin that you choose.'
          : 'Click the four corners counter-clockwise, beginning along a long side.',
      ),
      points.length + drafts.length
        ? h(
            'table.points',
            {},
            h(
              'thead',
              {},
              h(
                'tr',
                {},
                ['point', 'x [mm]', 'y [mm]', 'off [mm]', 'remove'].map((text) =>
                  h('th', {scope: 'col'}, text),
                ),
              ),
            ),
            h(
              'tbody',
              {},
              points.map((point, k) =>
                this.#row(
                  `known${k}`,
                  `P${k + 1}`,
                  point.table,
                  seen?.scale?.residuals[k],
                  (axis, value) =>
                    value !== null &&
                    this.#change((scale) => {
                      scale.points[k].table[axis] = value;
                    }),
                  () => this.#remove(k),
                ),
              ),
              drafts.map((draft, k) =>
                this.#row(
                  `draft${k}`,
                  `P${points.length + k + 1}`,
                  draft.table,
                  null,
                  (axis, value) => this.#typed(draft, axis, value),
                  () => this.#remove(points.length + k),
                ),
              ),
            ),
          )
        : null,
    );
  }

  #row(key, name, table, residual, onset, onremove) {
    const field = (axis) =>
      numeric({
        label: `${'xy'[axis]} of ${name} in mm`,
        value: table[axis],
        factor: 1e3,
        short: true,
        optional: true,
        onset: (value) => onset(axis, value),
      });
    return h(
      'tr',
      {key},
      h('th', {scope: 'row'}, name),
      h('td', {}, field(0)),
      h('td', {}, field(1)),
      h('td.number', {}, residual === null || residual === undefined ? '' : (1e3 * residual).toFixed(1)),
      h('td', {}, button('✕', onremove, {'aria-label': `Remove ${name}`})),
    );
  }

  /** Describe the marks of a photograph. */
  marks(photograph) {
    return this.#all(photograph).map((point, k) =>
      mark({
        name: `point ${k}`,
        at: point.pixel,
        kind: point.table.includes(null) ? 'draft' : 'known',
        text: `P${k + 1}`,
        label: `Point ${k + 1}. Arrow keys move it, Delete removes it.`,
      }),
    );
  }

  #all(photograph) {
    return [...photograph.scale.points, ...(this.#drafts.get(photograph.id) ?? [])];
  }

  tap(pixel) {
    const {photograph} = this.app;
    const sheet = SHEETS[this.#sheet];
    const k = this.#all(photograph).length;
    if (sheet && k < 4) {
      const table = [[0, 0], [sheet[0], 0], sheet, [0, sheet[1]]][k];
      this.#change((scale) => scale.points.push({pixel, table}));
      return;
    }
    const drafts = this.#drafts.get(photograph.id) ?? [];
    this.#drafts.set(photograph.id, [...drafts, {pixel, table: [null, null]}]);
    this.app.refresh();
    if (drafts.length) return;
    requestAnimationFrame(() =>
      requestAnimationFrame(() => document.querySelector('.points tbody tr:last-child input')?.focus()),
    );
  }

  grab(name) {
    const k = Number(name.split(' ')[1]);
    const merge = `drag ${name} ${Date.now()}`;
    return {move: (pixel) => this.#move(k, () => pixel, merge)};
  }

  nudge(name, by) {
    const k = Number(name.split(' ')[1]);
    this.#move(k, ([u, v]) => [u + by[0], v + by[1]], `nudge ${name}`);
  }

  press(name, key) {
    if (key !== 'Delete' && key !== 'Backspace') return false;
    this.#remove(Number(name.split(' ')[1]));
    return true;
  }

  #move(k, moved, merge) {
    const {photograph, seen} = this.app;
    const count = photograph.scale.points.length;
    const inside = ([u, v]) => [
      Math.min(seen.width - 1, Math.max(0, u)),
      Math.min(seen.height - 1, Math.max(0, v)),
    ];
    if (k < count) {
      this.#change((scale) => {
        scale.points[k].pixel = inside(moved(scale.points[k].pixel));
      }, merge);
    } else {
      const draft = this.#drafts.get(photograph.id)[k - count];
      draft.pixel = inside(moved(draft.pixel));
      this.app.refresh();
    }
  }

  #remove(k) {
    const {photograph} = this.app;
    const count = photograph.scale.points.length;
    if (k < count) this.#change((scale) => scale.points.splice(k, 1));
    else this.#drafts.get(photograph.id).splice(k - count, 1);
    this.app.refresh();
  }

  #typed(draft, axis, value) {
    draft.table[axis] = value;
    this.app.refresh();
    if (draft.table.includes(null)) return;
    const drafts = this.#drafts.get(this.app.id);
    drafts.splice(drafts.indexOf(draft), 1);
    this.#change((scale) => scale.points.push(draft));
  }

  #change(change, merge) {
    const {id} = this.app;
    this.app.project.edit((now) => change(now.photographs.find((photograph) => photograph.id === id).scale), {
      merge,
      place: PLACE,
    });
  }
}
