// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Step 3, the DLO: clicks along it, the line that snaps to it, and which strand is above at a crossing. */

import {crossingDrawn, question} from './crossing.js';
import {dloFields} from './dlo_fields.js';
import {h} from './dom.js';
import {distance, nearest, placesOf} from './geometry.js';
import {line, points, traced} from './line.js';
import {button, legend, mark, problem, tick, warnings} from './parts.js';
import {counted, millimetres} from './words.js';

const PLACE = 'trace';

export class TraceStep {
  title = 'DLO';
  sides = true;
  showStart = true;
  question = null; // number of the crossing that the person chose to answer
  later = new Set(); // crossings to be answered later: `photograph number`
  strand = null; // under the pointer in the question

  constructor(app) {
    this.app = app;
  }

  what() {
    return 'Click along the DLO from one end to the other, once at each bend; begin in every photograph at the same end.';
  }

  missing() {
    const {app} = this;
    const used = app.used();
    const open = used
      .filter(([, , id]) => !app.project.seen(id)?.trace)
      .map(([k, role]) => `the DLO at the ${app.placed(k, role)}`);
    const asked = used.flatMap(([k, role, id]) =>
      this.#open(id).length
        ? [`${counted(this.#open(id).length, 'crossing')} at the ${app.placed(k, role)}`]
        : [],
    );
    const all = [...open, ...asked];
    return all.length > 3 ? [...all.slice(0, 3), '…'] : all;
  }

  ready(id) {
    return Boolean(this.app.project.seen(id)?.trace) && !this.#open(id).length;
  }

  done() {
    const used = this.app.used();
    return used.length > 0 && used.every(([, , id]) => this.ready(id));
  }

  clicks() {
    return true;
  }

  #open(id) {
    return (this.app.project.seen(id)?.trace?.crossings ?? []).filter((crossing) => !crossing.answered);
  }

  get #start() {
    // the start's trace, drawn over the goal's photograph
    const {app} = this;
    const other =
      app.role === 'goal' ? app.entry.start : app.role === 'goal_side' ? app.entry.start_side : null;
    return other
      ? {id: other, trace: app.project.seen(other)?.trace, clicks: app.project.photograph(other).clicks}
      : null;
  }

  panel() {
    const {app} = this;
    const {photograph, seen} = app;
    if (!photograph) return [h('p', {}, 'There is no photograph yet: add one in step 1.')];
    const {clicks} = photograph;
    const start = this.#start;
    return [
      h('h3', {}, photograph.name),
      h('div', {role: 'status'}, this.#outcome(seen, clicks)),
      problem(app.project, PLACE),
      h(
        'div.row',
        {},
        start?.clicks.length && !clicks.length
          ? button('Begin with the start’s clicks', () => this.#set(() => structuredClone(start.clicks)))
          : null,
        button('Reverse the order', () => this.reverse(app.id), {disabled: clicks.length < 2}),
        button('Remove all clicks', () => this.#set(() => []), {disabled: !clicks.length}),
      ),
      start?.trace
        ? tick({
            label: 'Show where the DLO lay at the start',
            checked: this.showStart,
            key: 'start',
            onset: (value) => {
              this.showStart = value;
              app.refresh();
            },
          })
        : null,
      seen?.trace ? warnings(app, 2) : null,
      h(
        'details',
        {key: 'keys'},
        h('summary', {}, 'How to correct the line'),
        h(
          'ul.note',
          {},
          [
            'Drag a click, or choose it and move it with the arrow keys: 1 pixel, with Shift 10.',
            'Click on the line, or drag it, to insert a click there.',
            'Delete removes the chosen click.',
            'Wheel or two fingers: zoom. Drag beside the line: move the photograph. Keys: + − 0 and arrows; Enter clicks in the middle.',
          ].map((text) => h('li', {}, text)),
        ),
      ),
      dloFields(this.app, PLACE),
    ];
  }

  #outcome(seen, clicks) {
    if (seen?.trace_problem) return h('p.problem', {}, seen.trace_problem);
    if (!clicks.length) return h('p', {}, 'No clicks yet. Begin at one end of the DLO.');
    if (!seen?.trace) return h('p', {}, 'Go on: click the next bend, or the other end.');
    const {trace} = seen;
    const unsure = trace.sure.filter((sure) => !sure).length / trace.sure.length;
    return h(
      'div.outcome',
      {class: unsure > 0.02 ? 'weak' : 'good'},
      h(
        'p',
        {},
        `${counted(clicks.length, 'click')}. `,
        trace.length === null
          ? 'The length is known when the photograph has a scale.'
          : [
              h('strong', {}, millimetres(trace.length, 1)),
              ' long',
              trace.diameter ? `, ${millimetres(trace.diameter, 1)} thick` : '',
              '.',
            ],
      ),
      unsure > 0.02
        ? h(
            'p',
            {},
            `${Math.round(100 * unsure)} % of the line is not sure (dashed): check it, and click on the DLO where the line leaves it.`,
          )
        : null,
    );
  }

  drawn() {
    const {app} = this;
    const {photograph, seen} = app;
    const start = this.#start;
    return [
      start?.trace && this.showStart ? line(start.trace.pixels, 'before', 'before') : null,
      seen.trace
        ? h('polyline.hit', {key: 'hit', 'data-mark': 'line', points: points(seen.trace.pixels)})
        : null,
      ...traced(seen.trace),
      ...(seen.trace?.crossings ?? []).map((crossing, k) =>
        crossingDrawn(seen.trace, crossing, k, this.asked() === k ? this.strand : null, this.asked() === k),
      ),
      ...photograph.clicks.map((at, k) =>
        mark({
          name: `click ${k}`,
          at,
          kind: 'click',
          text: String(k + 1),
          label: `Click ${k + 1} of ${photograph.clicks.length}. Arrow keys move it, Delete removes it.`,
        }),
      ),
    ];
  }

  /** @returns {number | null} the crossing that is asked about */
  asked() {
    const crossings = this.app.seen?.trace?.crossings ?? [];
    if (this.question !== null && crossings[this.question]) return this.question;
    const k = crossings.findIndex((crossing, i) => !crossing.answered && !this.later.has(`${this.app.id} ${i}`));
    return k < 0 || this.held ? null : k;
  }

  bubbles() {
    const k = this.asked();
    return k === null ? [] : [question(this, this.app.seen.trace, k)];
  }

  /** Answer which strand is above at a crossing of the photograph. */
  answer(k, first) {
    const {app} = this;
    const {trace} = app.seen;
    const {pixel} = trace.crossings[k];
    this.question = null;
    this.strand = null;
    app.project.edit(
      (now) => {
        const photograph = now.photographs.find((other) => other.id === app.id);
        photograph.crossings = [
          ...photograph.crossings.filter((other) => distance(other.pixel, pixel) > 3 * trace.width),
          {pixel, first_above: first},
        ];
      },
      {place: PLACE},
    );
    app.say(`Crossing ${k + 1}: the ${first ? 'first' : 'second'} strand is above`);
  }

  /** Show the first crossing without an answer. */
  ask() {
    const {app} = this;
    const open = [
      [app.trial, 'start'],
      [app.trial, 'goal'],
    ].find(([k, role]) => this.#open(app.project.document.trials[k][role]).length);
    app.go(2);
    if (!open) return;
    app.choose(...open);
    this.later.clear();
    this.question = app.seen.trace.crossings.findIndex((crossing) => !crossing.answered);
    requestAnimationFrame(() => app.view.reveal(app.seen.trace.crossings[this.question].pixel));
  }

  /** Reverse the order of the clicks in a photograph. */
  reverse(id) {
    this.app.project.edit(
      (now) => {
        const photograph = now.photographs.find((other) => other.id === id);
        photograph.clicks.reverse();
        for (const answer of photograph.crossings) answer.first_above = !answer.first_above;
      },
      {place: PLACE},
    );
  }

  tap(pixel) {
    this.question = null;
    this.#set((clicks) => [...clicks, pixel]);
    this.app.say(`Click ${this.app.photograph.clicks.length}`);
  }

  grab(name, pixel) {
    const merge = `drag ${name} ${Date.now()}`;
    if (name.startsWith('crossing')) {
      return {
        move: () => {},
        end: () => {
          this.press(name, 'Enter');
        },
      };
    }
    let k = Number(name.split(' ')[1]);
    let inserted = name !== 'line';
    const insert = (at) => {
      k = this.#insert(at, merge);
      inserted = true;
    };
    return {
      move: (at) => {
        this.held = true;
        if (!inserted) insert(pixel);
        this.#set((clicks) => clicks.map((click, i) => (i === k ? at : click)), merge);
      },
      end: () => {
        this.held = false;
        if (!inserted) insert(pixel);
        this.app.project.settle();
        this.app.refresh();
      },
    };
  }

  nudge(name, by) {
    const k = Number(name.split(' ')[1]);
    if (!name.startsWith('click')) return;
    const {width, height} = this.app.seen;
    this.#set(
      (clicks) =>
        clicks.map(([u, v], i) =>
          i === k
            ? [Math.min(width - 1, Math.max(0, u + by[0])), Math.min(height - 1, Math.max(0, v + by[1]))]
            : [u, v],
        ),
      `nudge ${name}`,
    );
  }

  press(name, key) {
    const k = Number(name.split(' ')[1]);
    if (name.startsWith('crossing') && (key === 'Enter' || key === ' ')) {
      this.question = k;
      this.app.refresh();
      requestAnimationFrame(() =>
        requestAnimationFrame(() => document.querySelector('.bubble button')?.focus()),
      );
      return true;
    }
    if (!name.startsWith('click') || (key !== 'Delete' && key !== 'Backspace')) return false;
    this.#set((clicks) => clicks.filter((click, i) => i !== k));
    const next = Math.min(k, this.app.photograph.clicks.length - 1);
    requestAnimationFrame(() =>
      requestAnimationFrame(() =>
        (document.querySelector(`[data-mark="click ${next}"]`) ?? this.app.view.stage).focus({
          preventScroll: true,
        }),
      ),
    );
    return true;
  }

  /** Insert a click where the line passes; @returns {number} its number */
  #insert(pixel, merge) {
    const {photograph, seen} = this.app;
    const {pixels} = seen.trace;
    const places = placesOf(pixels, photograph.clicks);
    const {at} = nearest(pixels, pixel);
    const next = places.findIndex((place) => place > at);
    const k = next < 0 ? places.length : Math.max(next, at < places[0] ? 0 : 1);
    this.#set((clicks) => [...clicks.slice(0, k), pixel, ...clicks.slice(k)], merge);
    return k;
  }

  #set(change, merge) {
    const {id} = this.app;
    this.app.project.edit(
      (now) => {
        const photograph = now.photographs.find((other) => other.id === id);
        photograph.clicks = change(photograph.clicks);
      },
      {merge, place: PLACE},
    );
  }

  player() {
    const {seen} = this.app;
    if (!seen) return [];
    return [
      legend(
        [
          ['mark click', 'your click'],
          seen.trace ? ['sure', 'the DLO’s middle'] : null,
          seen.trace?.sure.includes(false) ? ['unsure', 'not sure: check it'] : null,
          this.#start?.trace && this.showStart ? ['before', 'where it lay at the start'] : null,
        ].filter(Boolean),
      ),
    ];
  }
}
