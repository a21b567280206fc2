// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/**
 * The view of a photograph: zoom, panning, and the drawing over it.
 *
 * Pixels are counted as everywhere in the package: u to the right and v down from the middle of the upper left one.
 */

import {patch} from './dom.js';
import {Picture} from './picture.js';

const MOST = 16; // times enlarged, in screen pixels for a pixel
const LABEL = [72, 18]; // screen pixels that a label takes; others within are left out
const NEAR = 8; // times that a hidden point counts where it is near to what a question asks about
const MARGIN = 0.96; // share of the stage that a whole photograph fills

export class View {
  #places = new Map(); // photograph -> scale, left and top when it was last shown
  #size = null; // of the photograph
  #shown = null;
  #points = []; // that questions should not hide
  #settled = false; // everything that was chosen is drawn

  /** @param {HTMLElement} stage with a canvas of pictures, an svg with a group, and a layer for questions */
  constructor(stage) {
    this.stage = stage;
    this.svg = stage.querySelector('svg');
    this.group = stage.querySelector('#drawn');
    this.layer = stage.querySelector('#bubbles');
    this.picture = new Picture(stage.querySelector('#pictures'), () => this.#announce());
    this.scale = 1;
    this.left = 0;
    this.top = 0;
    new ResizeObserver(() => this.#resized()).observe(stage);
  }

  /** @returns {{width: number, height: number}} of the stage, in screen pixels */
  get room() {
    return {width: this.stage.clientWidth, height: this.stage.clientHeight};
  }

  /**
   * Show a photograph; where it was seen before, as it was seen then.
   *
   * @param {string | null} id
   * @param {{width: number, height: number} | null} size in pixels
   * @param {HTMLElement | null} element that shows it; null: the picture of a photograph
   */
  show(id, size, element = null) {
    if (id === this.#shown) {
      if (element) this.picture.hold(element, size);
      return;
    }
    if (this.#shown) this.#places.set(this.#shown, [this.scale, this.left, this.top]);
    const alike = this.#size && size && size.width === this.#size.width && size.height === this.#size.height;
    const place = this.#places.get(id);
    this.#shown = id;
    this.#size = size;
    if (element) this.picture.hold(element, size);
    else this.picture.show(id, size);
    if (!size) return;
    if (place) [this.scale, this.left, this.top] = place;
    if (place || alike) this.#apply();
    else this.fit();
  }

  /** Announce a change: the stage is busy until `settle`, and until the photograph has a picture. */
  unsettle() {
    this.#settled = false;
    this.#announce();
  }

  /** Announce that everything is drawn. */
  settle() {
    this.#settled = true;
    this.#announce();
  }

  /** Show the whole photograph. */
  fit() {
    if (!this.#size) return;
    const {width, height} = this.room;
    this.scale = MARGIN * Math.min(width / this.#size.width, height / this.#size.height) || 1;
    this.left = (width - this.scale * this.#size.width) / 2;
    this.top = (height - this.scale * this.#size.height) / 2;
    this.fitted = true;
    this.#apply();
  }

  /** Zoom, so that what lies below a point of the stage stays there. */
  zoom(factor, x = this.room.width / 2, y = this.room.height / 2) {
    if (!this.#size) return;
    const least = 0.5 * Math.min(this.room.width / this.#size.width, this.room.height / this.#size.height);
    const scale = Math.min(MOST, Math.max(least, this.scale * factor));
    const ratio = scale / this.scale;
    this.left = x - ratio * (x - this.left);
    this.top = y - ratio * (y - this.top);
    this.scale = scale;
    this.fitted = false;
    this.#apply();
  }

  /** Move the photograph, in screen pixels; a part of it stays visible. */
  pan(x, y) {
    if (!this.#size) return;
    const {width, height} = this.room;
    const margin = 40;
    this.left = Math.min(width - margin, Math.max(margin - this.scale * this.#size.width, this.left + x));
    this.top = Math.min(height - margin, Math.max(margin - this.scale * this.#size.height, this.top + y));
    this.fitted = false;
    this.#apply();
  }

  /** Bring a pixel to the middle. */
  centre(pixel) {
    const [x, y] = this.place(pixel);
    this.pan(this.room.width / 2 - x, this.room.height / 2 - y);
  }

  /** Bring a pixel to the middle if it is not visible. */
  reveal(pixel) {
    const [x, y] = this.place(pixel);
    const {width, height} = this.room;
    if (x < 0 || y < 0 || x > width || y > height) this.centre(pixel);
  }

  /** @returns {[number, number]} the place on the stage, in screen pixels, of a pixel of the photograph */
  place([u, v]) {
    return [this.left + (u + 0.5) * this.scale, this.top + (v + 0.5) * this.scale];
  }

  /** @returns {[number, number]} the pixel at a place of the stage, moved into the photograph */
  pixel(x, y) {
    const {width, height} = this.#size ?? {width: 1, height: 1};
    return [
      Math.min(width - 1, Math.max(0, (x - this.left) / this.scale - 0.5)),
      Math.min(height - 1, Math.max(0, (y - this.top) / this.scale - 0.5)),
    ];
  }

  /** @returns {[number, number]} the place on the stage of an event of a pointer */
  under(event) {
    const box = this.stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** @returns {boolean} whether a place of the stage lies on the photograph */
  covers(x, y) {
    const {width, height} = this.#size ?? {width: 0, height: 0};
    return (
      x >= this.left &&
      y >= this.top &&
      x <= this.left + this.scale * width &&
      y <= this.top + this.scale * height
    );
  }

  /**
   * Draw over the photograph.
   *
   * @param {Array} drawn descriptions, in pixels of the photograph; those with data-u and data-v keep their size
   * @param {Array} bubbles descriptions of questions, placed at their data-u and data-v, with a data-gap in pixels
   * @param {Array<[number, number]>} points that the questions should not hide
   */
  draw(drawn, bubbles, points = []) {
    this.#points = points;
    patch(this.group, drawn);
    patch(this.layer, bubbles);
    this.#arrange();
  }

  #announce() {
    this.stage.setAttribute('aria-busy', String(!this.#settled || this.picture.loading));
  }

  #resized() {
    if (this.fitted) this.fit();
    else this.pan(0, 0);
  }

  #apply() {
    const shift = 0.5 * this.scale;
    this.group.setAttribute(
      'transform',
      `matrix(${this.scale} 0 0 ${this.scale} ${this.left + shift} ${this.top + shift})`,
    );
    this.picture.place(this.scale, this.left, this.top);
    this.#arrange();
  }

  #arrange() {
    for (const mark of this.group.querySelectorAll('[data-u]')) {
      const {u, v} = mark.dataset;
      mark.setAttribute('transform', `translate(${u} ${v}) scale(${1 / this.scale})`);
    }
    const labels = [];
    for (const label of this.group.querySelectorAll('.label')) {
      const [x, y] = this.place([Number(label.dataset.u), Number(label.dataset.v)]);
      const hides = labels.some(([u, v]) => Math.abs(u - x) < LABEL[0] && Math.abs(v - y) < LABEL[1]);
      label.setAttribute('visibility', hides ? 'hidden' : 'visible');
      if (!hides) labels.push([x, y]);
    }
    const {width, height} = this.room;
    for (const bubble of this.layer.children) {
      const [x, y] = this.place([Number(bubble.dataset.u), Number(bubble.dataset.v)]);
      const [wide, high] = [bubble.offsetWidth, bubble.offsetHeight];
      const gap = 20 + Number(bubble.dataset.gap ?? 0) * this.scale;
      const within = (value, most) => Math.min(most - 8, Math.max(8, value));
      const corners = [
        [x + gap, y - high / 2],
        [x - gap - wide, y - high / 2],
        [x - wide / 2, y + gap],
        [x - wide / 2, y - gap - high],
      ].map(([left, top]) => [within(left, width - wide), within(top, height - high)]);
      const hidden = corners.map(([left, top]) =>
        this.#points.reduce((sum, point) => {
          const [u, v] = this.place(point);
          const inside = u > left - 8 && u < left + wide + 8 && v > top - 8 && v < top + high + 8;
          return sum + (inside ? (Math.hypot(u - x, v - y) < gap ? NEAR : 1) : 0);
        }, 0),
      );
      const [left, top] = corners[hidden.indexOf(Math.min(...hidden))];
      bubble.style.setProperty('transform', `translate(${Math.round(left)}px, ${Math.round(top)}px)`);
    }
  }
}
