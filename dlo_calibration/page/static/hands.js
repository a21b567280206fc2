// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Step 4, hands: their movements between start and goal. */

import {h} from './dom.js';
import {along, during, nearest, tableMap} from './geometry.js';
import {stepCard} from './hand_fields.js';
import {HANDS, labelled, letter, spoken} from './hand_names.js';
import {line, traced} from './line.js';
import {button, hand, legend, mark, problem, warnings} from './parts.js';
import {pictures} from './pictures.js';

const PLACE = 'hands';

export class HandsStep {
  title = 'Hands';
  role = 'start';
  chosen = 0; // number of the step whose fields are open
  adding = false;
  #maps = new WeakMap();

  constructor(app) {
    this.app = app;
  }

  what() {
    return this.app.hangs(this.app.entry)
      ? 'No hand moves in this trial: the DLO hangs between two clamps.'
      : 'Describe what the hand did: where it gripped the DLO, how it moved, and where it opened.';
  }

  /** List [trial, role] without a movement of a hand. */
  open() {
    return this.app.project.document.trials.flatMap((trial, k) => (this.#told(trial) ? [] : [[k, 'start']]));
  }

  missing() {
    const {trials} = this.app.project.document;
    const open = trials.flatMap((trial, k) =>
      this.#told(trial) ? [] : [`what the hand did in trial ${k + 1}`],
    );
    return trials.length ? open : ['a trial'];
  }

  done() {
    const {trials} = this.app.project.document;
    return trials.length > 0 && trials.every((trial) => this.#told(trial));
  }

  /** @returns {boolean} whether the movements of a trial are described, or nothing moves in it */
  #told(trial) {
    return trial.steps.length > 0 || this.app.hangs(trial);
  }

  clicks() {
    return this.app.role === 'start' ? this.#step?.kind === 'path' : this.#opening;
  }

  /** @returns {boolean} whether the chosen movement ended with an opening hand, whose place can be marked */
  get #opening() {
    return Boolean(this.#step && 'to' in this.#step && !this.#step.hold);
  }

  /** Show the goal photograph, to mark the place where the hand opened. */
  markPlace() {
    const {app} = this;
    app.go(3);
    app.choose(app.trial, 'goal');
    if (this.#opening && !this.#step.to)
      this.#place(this.chosen, this.#marks().find((mark) => mark.name === `open ${this.chosen} 0`)?.at);
  }

  #place(k, pixel, merge) {
    const map = this.#map(this.app.role);
    if (map && pixel)
      this.change(
        k,
        (step) => {
          step.to = map.table(pixel);
        },
        merge,
      );
  }

  get #step() {
    return this.app.entry?.steps[this.chosen];
  }

  kind(name) {
    return this.app.project.state.actions.find((action) => action.kind === name);
  }

  panel() {
    const {app} = this;
    const {entry} = app;
    if (!entry) return [h('p', {}, 'There is no trial yet: add photographs in step 1.')];
    if (app.hangs(entry)) return [warnings(app, 3)];
    const {steps} = entry;
    if (!steps.length || this.adding) return [...this.#list(steps.length), problem(app.project, PLACE)];
    this.chosen = Math.min(this.chosen, steps.length - 1);
    return [
      h(
        'p.note',
        {},
        app.role === 'start'
          ? 'Drag the mark along the DLO to the point that the hand gripped.'
          : this.#opening
            ? 'Click where the hand opened, or drag the mark there. The DLO springs back when the hand opens, so its point may now lie elsewhere.'
            : 'The mark shows the gripped point at the goal.',
      ),
      h(
        'ol.steplist',
        {},
        steps.map((step, k) => h('li', {key: k}, stepCard(this, step, k, k === this.chosen))),
      ),
      button('Add another movement', () => {
        this.adding = true;
        app.refresh();
      }),
      problem(app.project, PLACE),
      warnings(app, 3),
    ];
  }

  #list(some) {
    return [
      h(
        'h3',
        {},
        some
          ? 'What did a hand do next, or at the same time?'
          : `What did the hand do in trial ${this.app.trial + 1}?`,
      ),
      h(
        'ul.actions',
        {},
        this.app.project.state.actions.map((action) =>
          h(
            'li',
            {key: action.kind},
            h(
              'button',
              {type: 'button', onclick: () => this.#add(action.kind)},
              pictures[action.kind]?.() ?? null,
              h('span', {}, h('strong', {}, action.title), h('small', {}, action.text)),
            ),
          ),
        ),
      ),
      some
        ? button('Cancel', () => {
            this.adding = false;
            this.app.refresh();
          })
        : null,
    ];
  }

  #add(kind) {
    const {fields} = this.kind(kind);
    const step = {kind, with_previous: false};
    for (const [name, field] of Object.entries(fields)) step[name] = structuredClone(field.default);
    this.adding = false;
    this.chosen = this.app.entry.steps.length;
    this.app.role = 'start';
    requestAnimationFrame(() =>
      requestAnimationFrame(() =>
        document.querySelector('.stepcard.open')?.scrollIntoView({block: 'nearest'}),
      ),
    );
    this.app.project.edit((now) => now.trials[this.app.trial].steps.push(step), {place: PLACE});
  }

  /** Change a step of the trial. */
  change(k, change, merge) {
    const {trial} = this.app;
    this.app.project.edit((now) => change(now.trials[trial].steps[k], now.trials[trial].steps), {
      merge,
      place: PLACE,
    });
  }

  /** @returns {Array | null} the chain in a photograph of the trial: points evenly along the DLO */
  chain(role) {
    const id = this.app.entry?.[role];
    const trace = id && this.app.project.seen(id)?.trace;
    return trace ? (trace.chain ?? trace.pixels) : null;
  }

  /** @returns {{table: Function, pixel: Function} | null} between the table and a photograph of the trial */
  #map(role) {
    const {project, entry} = this.app;
    const scale = project.seen(entry[role])?.scale;
    if (!scale) return null;
    if (!this.#maps.has(scale)) this.#maps.set(scale, tableMap(scale.lattice));
    return this.#maps.get(scale);
  }

  /** List the marks of a photograph: {name, at, hand, label, step, …}. */
  #marks() {
    const {role, entry} = this.app;
    const chain = this.chain(role);
    if (!chain || !entry) return [];
    const at = (fraction) => along(chain, fraction * (chain.length - 1));
    return entry.steps.flatMap((step, k) => {
      const hands = step.hands ?? [step.hand];
      const fractions = step.fractions ?? (step.fraction === undefined ? [] : [step.fraction]);
      const grips = fractions.map((fraction, i) => ({
        name: `grip ${k} ${i}`,
        at: at(fraction),
        hand: hands[i],
        fraction,
      }));
      if (role === 'start') {
        const map = this.#map(role);
        const way = (step.waypoints ?? []).map(
          ([x, y], i) => map && {name: `way ${k} ${i}`, at: map.pixel([x, y]), hand: hands[0], way: i},
        );
        return [...grips, ...way.filter(Boolean)];
      }
      if (!('to' in step) || step.hold) return grips.map((grip) => ({...grip, fixed: true}));
      const map = this.#map(role);
      const to = step.to && map ? map.pixel(step.to) : grips[0].at;
      return [{...grips[0], name: `open ${k} 0`, at: to, fixed: !map}];
    });
  }

  drawn() {
    const {app} = this;
    const {seen, role, entry} = app;
    const hands = app.project.state.trials[app.trial]?.hands ?? [];
    const paths = hands.map((path, i) => [
      path,
      (role === 'start' ? path.start_pixels : path.goal_pixels) ?? [],
      i,
    ]);
    const colour = (name) => `hand${Math.max(0, HANDS.indexOf(name)) % 2}`;
    return [
      ...traced(seen.trace),
      ...paths
        .filter(([, pixels]) => pixels.length > 1)
        .map(([{name}, pixels, i]) => line(pixels, `way ${colour(name)}`, `path${i}`)),
      ...this.#marks().map((place) => {
        const given = {
          name: place.name,
          at: place.at,
          kind: `${colour(place.hand)} ${place.way === undefined ? 'grip' : 'waypoint'}`,
          text: place.way === undefined ? letter(place.hand) : String(place.way + 1),
          label: labelled(place, entry),
        };
        return place.fixed
          ? h(
              'g.shown',
              {key: place.name, class: given.kind, 'data-u': place.at[0], 'data-v': place.at[1]},
              h('circle.dot', {r: 6.5}),
              h('text', {x: 11, y: -9}, given.text),
            )
          : mark(given);
      }),
      ...(this.#moving
        ? paths
            .filter(([, pixels]) => pixels.length)
            .map(([{name, times}, pixels, i]) =>
              hand(`playing${i}`, colour(name), during(times, pixels, app.player.time)),
            )
        : []),
    ];
  }

  get #moving() {
    return this.app.player.playing || this.app.player.time > 0;
  }

  tap(pixel) {
    if (!this.clicks()) return;
    if (this.app.role === 'goal') this.#place(this.chosen, pixel);
    const map = this.app.role === 'start' ? this.#map('start') : null;
    if (!map) return;
    const [x, y] = map.table(pixel);
    this.change(this.chosen, (step) => step.waypoints.push([x, y, step.waypoints.at(-1)?.[2] ?? 0]));
  }

  grab(name) {
    const merge = `drag ${name} ${Date.now()}`;
    const [, k] = name.split(' ').map(Number);
    this.chosen = k;
    this.app.refresh();
    return {move: (pixel) => this.#moved(name, () => pixel, merge), end: () => this.app.project.settle()};
  }

  nudge(name, by) {
    const [what, k, i] = name.split(' ');
    if (what === 'grip') {
      const share = (by[0] - by[1]) / 1000; // 1 press: 0.1 % of the length, with Shift 1 %
      this.#fraction(Number(k), Number(i), (before) => before + share, `nudge ${name}`);
    } else {
      this.#moved(name, ([u, v]) => [u + by[0], v + by[1]], `nudge ${name}`);
    }
  }

  press(name, key) {
    const [what, k, i] = name.split(' ');
    if (key !== 'Delete' && key !== 'Backspace') return false;
    if (what === 'way') this.change(Number(k), (step) => step.waypoints.splice(Number(i), 1));
    else if (what === 'open')
      this.change(Number(k), (step) => {
        step.to = null;
      });
    return true;
  }

  #moved(name, moved, merge) {
    const [what, k, i] = name.split(' ');
    const {app} = this;
    const chain = this.chain(app.role);
    const {at} = this.#marks().find((mark) => mark.name === name);
    const pixel = moved(at);
    if (what === 'grip') {
      const place = nearest(chain, pixel);
      this.#fraction(Number(k), Number(i), () => place.at / (chain.length - 1), merge);
      return;
    }
    const map = this.#map(app.role);
    const [x, y] = map.table(pixel);
    if (what === 'way') {
      this.change(
        Number(k),
        (step) => {
          step.waypoints[Number(i)] = [x, y, step.waypoints[Number(i)][2]];
        },
        merge,
      );
      return;
    }
    this.#place(Number(k), pixel, merge);
  }

  #fraction(k, i, change, merge) {
    const bounded = (value) => Math.min(1, Math.max(0, Number(value.toFixed(4))));
    this.change(
      k,
      (step) => {
        if (step.fractions) step.fractions[i] = bounded(change(step.fractions[i]));
        else step.fraction = bounded(change(step.fraction));
      },
      merge,
    );
  }

  player() {
    const {app} = this;
    const hands = app.project.state.trials[app.trial]?.hands ?? [];
    const end = Math.max(0, ...hands.flatMap(({times}) => times));
    const names = [...new Set((app.entry?.steps ?? []).flatMap((step) => step.hands ?? [step.hand]))];
    return [
      end > 0 && app.seen ? app.player.controls(end, 'Movement of the hands') : null,
      legend(
        [
          ['sure', 'the DLO’s middle'],
          ...names.map((name) => [
            `mark hand${Math.max(0, HANDS.indexOf(name))} grip`,
            `${letter(name)}: ${spoken(name)}`,
          ]),
          hands.length ? ['way', 'its path'] : null,
        ].filter(Boolean),
      ),
    ];
  }
}
