// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The clamps between which a DLO hangs: its length or their distance gives the scale. */

import {h} from './dom.js';
import {PLACE} from './known_points.js';
import {button, mark, numeric} from './parts.js';
import {counted} from './words.js';

export const HANGING = {kind: 'hanging', length: null, gap: null, clamps: []};

/** @returns {boolean} whether a photograph of the document shows a DLO that hangs */
export function hangs(photograph) {
  return photograph?.scale?.kind === 'hanging';
}

export class Clamps {
  constructor(app) {
    this.app = app;
  }

  /** Describe the fields. */
  panel({scale}) {
    const field = (name, label) =>
      numeric({
        label,
        unit: 'mm',
        factor: 1e3,
        minimum: 1e-3,
        maximum: 100,
        optional: true,
        value: scale[name],
        key: name,
        onset: (value) =>
          this.#change((now) => {
            Object.assign(now, {length: null, gap: null, [name]: value});
          }, name),
      });
    return h(
      'div.group',
      {key: 'hanging'},
      h(
        'p.note',
        {},
        'The DLO hangs between two clamps, and the camera looks squarely at it. Give one of both lengths; that of the DLO is more exact.',
      ),
      field('length', 'Length of the DLO from clamp to clamp'),
      field('gap', 'Distance of the clamps, where the DLO leaves them'),
      h(
        'p',
        {},
        'Click in both clamps, on the middle of the DLO, in the order of your clicks along it: this gives their direction. ',
        `${counted(scale.clamps.length, 'clamp is', 'clamps are')} marked.`,
      ),
      button('Remove the marks of the clamps', () => this.#change((now) => now.clamps.splice(0)), {
        disabled: !scale.clamps.length,
      }),
    );
  }

  /** Describe the marks of a photograph. */
  marks({scale}) {
    return scale.clamps.map((at, k) =>
      mark({
        name: `clamp ${k}`,
        at,
        kind: 'known',
        text: `C${k + 1}`,
        label: `Clamp ${k + 1}. Arrow keys move it, Delete removes it.`,
      }),
    );
  }

  tap(pixel) {
    this.#change((scale) => {
      scale.clamps = [...scale.clamps, pixel].slice(-2);
    });
  }

  grab(name) {
    const merge = `drag ${name} ${Date.now()}`;
    return {move: (pixel) => this.#move(name, () => pixel, merge)};
  }

  nudge(name, by) {
    this.#move(name, ([u, v]) => [u + by[0], v + by[1]], `nudge ${name}`);
  }

  press(name, key) {
    if (key !== 'Delete' && key !== 'Backspace') return false;
    this.#change((scale) => scale.clamps.splice(Number(name.split(' ')[1]), 1));
    return true;
  }

  #move(name, moved, merge) {
    const k = Number(name.split(' ')[1]);
    this.#change((scale) => {
      scale.clamps[k] = moved(scale.clamps[k]);
    }, merge);
  }

  #change(change, merge) {
    const {id} = this.app;
    this.app.project.edit((now) => change(now.photographs.find((photograph) => photograph.id === id).scale), {
      merge,
      place: PLACE,
    });
  }
}
