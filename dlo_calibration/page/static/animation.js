// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The animation: the simulated DLO over a photograph, through time. */

import {h} from './dom.js';
import {line, traced} from './line.js';
import {button, hand, legend} from './parts.js';

export class Animation {
  #animations = new Map(); // trial and photograph -> animation, null while it is simulated
  #of = null; // the result that the animations belong to
  #failed = new Set();

  constructor(app) {
    this.app = app;
  }

  /** @returns {object | null} the animation of the trial and photograph that are worked on */
  get #animation() {
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
      this.#animations.clear();
      this.#failed.clear();
    }
    const key = `${app.trial} ${app.id}`;
    if (!this.#animations.has(key) && !this.#failed.has(key)) this.#fetch(key, app.trial, app.id);
    return this.#animations.get(key) ?? null;
  }

  async #fetch(key, trial, id) {
    const {app} = this;
    const of = this.#of;
    this.#animations.set(key, null);
    const animation = await app.project.ask(`animation/${trial}?photograph=${encodeURIComponent(id)}`, {
      method: 'GET',
      place: 'animation',
    });
    if (this.#of !== of) return;
    if (animation) this.#animations.set(key, animation);
    else this.#failed.add(key);
    if (animation && app.role === 'goal') app.player.stop(animation.times[animation.goal]);
    app.refresh();
  }

  drawn() {
    const {app} = this;
    const animation = this.#animation;
    if (!animation) return traced(app.seen.trace);
    const k = frame(animation.times, app.player.time);
    return [
      ...traced(app.seen.trace),
      line(animation.pixels[k], 'simulated', 'simulated'),
      ...animation.hands.map(({[k]: pixel}, i) => (pixel ? hand(`hand${i}`, `hand${i % 2}`, pixel) : null)),
    ];
  }

  player() {
    const {app} = this;
    if (!app.seen) return [];
    const animation = this.#animation;
    const asked =
      !animation && this.#animations.has(`${app.trial} ${app.id}`) && !this.#failed.has(`${app.trial} ${app.id}`);
    const atGoal = animation && frame(animation.times, app.player.time) === animation.goal;
    const refused = app.project.problem?.place === 'animation' ? app.project.problem.text : null;
    return [
      animation
        ? app.player.controls(
            animation.times.at(-1),
            'Animation of the simulated DLO',
            atGoal && app.role === 'goal' ? 'compared with the goal' : '',
          )
        : asked
          ? h('p.note', {role: 'status'}, 'The animation is being simulated …')
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
      legend([['sure', 'measured'], animation ? ['simulated', 'simulated'] : null].filter(Boolean)),
    ];
  }
}

/** @returns {number} index of the frame at a time */
function frame(times, time) {
  let k = 0;
  while (k + 1 < times.length && times[k + 1] <= time + 1e-9) k++;
  return k;
}
