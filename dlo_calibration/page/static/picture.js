// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The picture of a photograph: first a small one, larger ones when they are needed. */

const WIDTHS = [320, 1600, Infinity]; // of the pictures from the server; Infinity: the full width
const SOFT = 1.15; // a picture is enlarged by so much before a larger one is fetched

/** @param {string} id @param {number} width @returns {string} the address of a picture */
export function address(id, width) {
  return `api/photographs/${encodeURIComponent(id)}/picture${Number.isFinite(width) ? `?width=${width}` : ''}`;
}

export class Picture {
  #id = null;
  #size = null;
  #level = -1; // of the sharpest picture that is shown
  #asked = -1;

  /** @param {HTMLElement} holder @param {() => void} onload called when a photograph's picture is shown */
  constructor(holder, onload) {
    this.holder = holder;
    this.onload = onload;
  }

  /** @returns {boolean} whether the photograph has no picture yet */
  get loading() {
    return this.#id !== null && this.#level < 0;
  }

  /** Show a photograph of a size in pixels; null: none. */
  show(id, size) {
    this.#id = id;
    this.#size = size;
    this.#level = -1;
    this.#asked = -1;
    this.holder.replaceChildren();
    if (id) this.#ask(0);
  }

  /** Show an element, such as a film, of a size in pixels. */
  hold(element, size) {
    this.#id = null;
    this.#size = size;
    this.#asked = WIDTHS.length;
    if (this.holder.firstChild !== element) this.holder.replaceChildren(element);
    this.onload();
  }

  /** Place the picture, and fetch a sharper one where this one is too coarse. */
  place(scale, left, top) {
    if (!this.#size) return;
    const {style} = this.holder;
    style.setProperty('width', `${this.#size.width}px`);
    style.setProperty('height', `${this.#size.height}px`);
    style.setProperty('transform', `matrix(${scale}, 0, 0, ${scale}, ${left}, ${top})`);
    this.holder.classList.toggle('close', scale * devicePixelRatio > 3);
    const wanted = (scale * devicePixelRatio * this.#size.width) / SOFT;
    const level = WIDTHS.findIndex((width) => width >= wanted || width >= this.#size.width);
    if (level > this.#asked) this.#ask(level);
  }

  async #ask(level) {
    const id = this.#id;
    this.#asked = level;
    const image = new Image();
    image.alt = '';
    image.draggable = false;
    image.src = address(id, WIDTHS[level]);
    try {
      await image.decode(); // outside the page's thread, so that nothing stutters
    } catch {
      if (this.#id === id && this.#asked === level) this.#asked = this.#level;
      return;
    }
    if (this.#id !== id || level <= this.#level) return;
    this.#level = level;
    this.holder.replaceChildren(image);
    this.onload();
  }
}
