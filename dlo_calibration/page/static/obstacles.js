// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Obstacles: pegs and boxes that stand on the table, each by two clicks on its top and a height. */

import {h} from './dom.js';
import {line} from './line.js';
import {button, mark, numeric, problem} from './parts.js';
import {millimetres} from './words.js';

const PLACE = 'obstacles';
const HEIGHT = 0.05; // m, until the person types another one
const ENDS = ['first', 'second'];
const ASKED = {
  peg: ['Click the middle of the peg’s top.', 'Click a place on the rim of its top.'],
  box: ['Click a corner of the box’s top.', 'Click the opposite corner of its top.'],
};

export class Obstacles {
  #placing = null; // {kind, photograph, first}: an obstacle that is being clicked

  constructor(app) {
    this.app = app;
  }

  /** @returns {boolean} whether the next click belongs to an obstacle */
  get placing() {
    return this.#placing !== null && this.#placing.photograph === this.app.id;
  }

  get #all() {
    return this.app.project.document.obstacles;
  }

  /** Describe the fields. */
  panel() {
    const {app} = this;
    const ready = Boolean(app.seen?.scale);
    const all = this.#all;
    if (!ready && !all.length) return null;
    const add = (kind) =>
      button(`Add a ${kind}`, () => this.#begin(kind), {
        disabled: !ready,
        'aria-pressed': String(this.placing && this.#placing.kind === kind),
      });
    return h(
      'details',
      {key: 'obstacles', open: all.length > 0 || this.placing},
      h('summary', {}, 'Obstacles that the DLO touches'),
      h(
        'p.note',
        {},
        'Pegs and boxes that stand on the table and do not move. Type the height of each; the lines around its top and its foot must then lie on it in all photographs.',
      ),
      h('div.row', {}, add('peg'), add('box')),
      h(
        'div',
        {role: 'status'},
        this.placing
          ? h(
              'p',
              {},
              ASKED[this.#placing.kind][this.#placing.first ? 1 : 0],
              ' ',
              button('Cancel', () => this.#end()),
            )
          : null,
      ),
      problem(app.project, PLACE),
      all.length ? this.#table() : null,
    );
  }

  #table() {
    return h(
      'table.points.obstacles',
      {},
      h(
        'thead',
        {},
        h(
          'tr',
          {},
          ['obstacle', 'height [mm]', 'turn [°]', 'remove'].map((text) => h('th', {scope: 'col'}, text)),
        ),
      ),
      h(
        'tbody',
        {},
        this.#all.map((obstacle, k) => this.#row(obstacle, k)),
      ),
    );
  }

  #row(obstacle, k) {
    const {sizes, problem: why} = this.app.project.state.obstacles[k] ?? {};
    const name = `${obstacle.kind} ${k + 1}`;
    const size = !sizes
      ? ''
      : obstacle.kind === 'peg'
        ? `, ${millimetres(2 * sizes[1], 1)} thick`
        : `, ${millimetres(sizes[0], 0)} by ${millimetres(sizes[1], 0)}`;
    return h(
      'tr',
      {key: `obstacle${k}`},
      h('th', {scope: 'row'}, name, size, why ? h('p.problem', {}, why) : null),
      h(
        'td',
        {},
        numeric({
          label: `Height of ${name} in mm`,
          value: obstacle.height,
          factor: 1e3,
          minimum: 1e-3,
          maximum: 2,
          short: true,
          onset: (height) => this.#change(k, (one) => Object.assign(one, {height})),
        }),
      ),
      h(
        'td',
        {},
        obstacle.kind === 'box'
          ? numeric({
              label: `Turn of ${name} in degrees`,
              value: obstacle.turn,
              factor: 180 / Math.PI,
              minimum: -Math.PI,
              maximum: Math.PI,
              short: true,
              onset: (turn) => this.#change(k, (one) => Object.assign(one, {turn})),
            })
          : null,
      ),
      h('td', {}, button('✕', () => this.#remove(k), {'aria-label': `Remove ${name}`})),
    );
  }

  /** Describe the lines and marks over the photograph. */
  drawn() {
    const {id, seen} = this.app;
    const lines = (seen.obstacles ?? []).map((pixels, k) => line(pixels, 'obstacle', `around ${k}`));
    const marks = this.#all.flatMap((obstacle, k) =>
      obstacle.photograph === id
        ? ENDS.map((end, part) =>
            mark({
              name: `obstacle ${k} ${part}`,
              at: obstacle[end],
              kind: 'known',
              text: part ? '' : String(k + 1),
              label: `${part ? 'Second' : 'First'} click of ${obstacle.kind} ${k + 1}. Arrow keys move it, Delete removes the ${obstacle.kind}.`,
            }),
          )
        : [],
    );
    const begun =
      this.placing && this.#placing.first
        ? [
            mark({
              name: 'obstacle begun',
              at: this.#placing.first,
              kind: 'draft',
              label: 'First click of the new obstacle',
            }),
          ]
        : [];
    return [...lines, ...marks, ...begun];
  }

  tap(pixel) {
    const {kind, first, photograph} = this.#placing;
    if (!first) {
      this.#placing = {kind, photograph, first: pixel};
      this.app.refresh();
      return;
    }
    this.#placing = null;
    this.app.project.edit(
      (now) => now.obstacles.push({photograph, kind, first, second: pixel, height: HEIGHT, turn: 0}),
      {place: PLACE},
    );
    this.app.say(`The ${kind} is obstacle ${this.#all.length}; type its height`);
    requestAnimationFrame(() =>
      requestAnimationFrame(() => document.querySelector('.obstacles tbody tr:last-child input')?.select()),
    );
  }

  grab(name) {
    if (name === 'obstacle begun') return null;
    const merge = `drag ${name} ${Date.now()}`;
    return {move: (pixel) => this.#move(name, () => pixel, merge), end: () => this.app.project.settle()};
  }

  nudge(name, by) {
    if (name !== 'obstacle begun') this.#move(name, ([u, v]) => [u + by[0], v + by[1]], `nudge ${name}`);
  }

  press(name, key) {
    if (key !== 'Delete' && key !== 'Backspace') return false;
    if (name === 'obstacle begun') this.#end();
    else this.#remove(Number(name.split(' ')[1]));
    return true;
  }

  #begin(kind) {
    this.#placing = {kind, photograph: this.app.id, first: null};
    this.app.project.clear();
    this.app.refresh();
  }

  #end() {
    this.#placing = null;
    this.app.refresh();
  }

  #move(name, moved, merge) {
    const [, k, part] = name.split(' ').map(Number);
    const {width, height} = this.app.seen;
    this.#change(
      k,
      (one) => {
        const [u, v] = moved(one[ENDS[part]]);
        one[ENDS[part]] = [Math.min(width - 1, Math.max(0, u)), Math.min(height - 1, Math.max(0, v))];
      },
      merge,
    );
  }

  #remove(k) {
    this.app.project.edit((now) => now.obstacles.splice(k, 1), {place: PLACE});
  }

  #change(k, change, merge) {
    this.app.project.edit((now) => change(now.obstacles[k]), {merge, place: PLACE});
  }
}
