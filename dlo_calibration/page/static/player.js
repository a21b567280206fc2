// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** A player: a time that runs, or is dragged. */

import {h} from './dom.js';

const LEAST = 2; // s: a shorter motion is played in slow motion
const MOST = 12; // s: a longer one in quick motion

export class Player {
  time = 0;
  playing = false;
  #end = 0;
  #last = 0;

  /** @param {() => void} changed is called when the time changes */
  constructor(changed) {
    this.changed = changed;
  }

  /** Stop, and go to a time. */
  stop(time = 0) {
    this.playing = false;
    this.time = time;
  }

  /**
   * Describe the controls for a motion.
   *
   * @param {number} end of the motion [s]
   * @param {string} label
   * @param {string} words a note beside the time
   */
  controls(end, label, words = '') {
    this.#end = end;
    this.time = Math.min(this.time, end);
    return h(
      'div.controls',
      {key: label, role: 'group', 'aria-label': label},
      h(
        'button',
        {type: 'button', onclick: () => this.#toggle(), 'aria-label': this.playing ? 'Pause' : 'Play'},
        this.playing ? '❚❚' : '▶',
      ),
      h('input', {
        type: 'range',
        min: 0,
        max: end,
        step: end / 200 || 1,
        value: String(this.time),
        'aria-label': label,
        'aria-valuetext': `${this.time.toFixed(1)} seconds`,
        oninput: (event) => {
          this.stop(Number(event.target.value));
          this.changed();
        },
      }),
      h('output', {}, `${this.time.toFixed(1)} s`),
      words ? h('span.note', {}, words) : null,
    );
  }

  #toggle() {
    this.playing = !this.playing;
    if (this.playing && this.time >= this.#end) this.time = 0;
    this.#last = performance.now();
    if (this.playing) requestAnimationFrame((now) => this.#tick(now));
    this.changed();
  }

  #tick(now) {
    if (!this.playing) return;
    const pace = this.#end / Math.min(MOST, Math.max(LEAST, this.#end));
    this.time = Math.min(this.#end, this.time + (pace * (now - this.#last)) / 1e3);
    this.#last = now;
    if (this.time >= this.#end) this.playing = false;
    else requestAnimationFrame((next) => this.#tick(next));
    this.changed();
  }
}
