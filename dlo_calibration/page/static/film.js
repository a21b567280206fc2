// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The film: the simulated DLO over a photograph, through time. */

import {h} from './dom.js';
import {line, traced} from './line.js';
import {button, hand, legend} from './parts.js';

export class Film {
  #films = new Map(); // trial and photograph -> film, null while it is simulated
  #of = null; // the result that the films belong to
  #failed = new Set();

  constructor(app) {
    this.app = app;
  }

  /** @returns {object | null} the film of the trial and photograph that are worked on */
  get #film() {
    const {app} = this;
    const {calibration} = app.project.state;
    const {result} = calibration;
    if (
      !result ||
      result.outdated ||
      calibration.state === 'calibrating' ||
      !app.seen?.scale ||
      !app.entry?.goal
    )
      return null;
    const of = JSON.stringify([result.parameters, app.project.state.revision]);
    if (of !== this.#of) {
      this.#of = of;
      this.#films.clear();
      this.#failed.clear();
    }
    const key = `${app.trial} ${app.id}`;
    if (!this.#films.has(key) && !this.#failed.has(key)) this.#fetch(key, app.trial, app.id);
    return this.#films.get(key) ?? null;
  }

  async #fetch(key, trial, id) {
    const {app} = this;
    const of = this.#of;
    this.#films.set(key, null);
    const film = await app.project.ask(`film/${trial}?photograph=${encodeURIComponent(id)}`, {
      method: 'GET',
      place: 'film',
    });
    if (this.#of !== of) return;
    if (film) this.#films.set(key, film);
    else this.#failed.add(key);
    if (film && app.role === 'goal') app.player.stop(film.times[film.goal]);
    app.refresh();
  }

  drawn() {
    const {app} = this;
    const film = this.#film;
    if (!film) return traced(app.seen.trace);
    const k = frame(film.times, app.player.time);
    return [
      ...traced(app.seen.trace),
      line(film.pixels[k], 'simulated', 'simulated'),
      ...film.hands.map(({[k]: pixel}, i) => (pixel ? hand(`hand${i}`, `hand${i % 2}`, pixel) : null)),
    ];
  }

  player() {
    const {app} = this;
    if (!app.seen) return [];
    const film = this.#film;
    const asked =
      !film && this.#films.has(`${app.trial} ${app.id}`) && !this.#failed.has(`${app.trial} ${app.id}`);
    const atGoal = film && frame(film.times, app.player.time) === film.goal;
    const refused = app.project.problem?.place === 'film' ? app.project.problem.text : null;
    return [
      film
        ? app.player.controls(
            film.times.at(-1),
            'Film of the simulated DLO',
            atGoal && app.role === 'goal' ? 'compared with the goal' : '',
          )
        : asked
          ? h('p.note', {role: 'status'}, 'The film is being simulated …')
          : refused
            ? h(
                'p.problem',
                {role: 'alert'},
                refused,
                button('Try again', () => {
                  this.#failed.clear();
                  app.refresh();
                }),
              )
            : null,
      legend([['sure', 'measured'], film ? ['simulated', 'simulated'] : null].filter(Boolean)),
    ];
  }
}

/** @returns {number} index of the frame at a time */
function frame(times, time) {
  let k = 0;
  while (k + 1 < times.length && times[k + 1] <= time + 1e-9) k++;
  return k;
}
