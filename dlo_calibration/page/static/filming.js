// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** A film: clicks along the DLO, the line that follows it, its trials, and the simulated DLO over it. */

import {advised, arrows} from './advice.js';
import {timeBlocks} from './blocks.js';
import {h} from './dom.js';
import {line} from './line.js';
import {button, legend, mark, numeric, problem, tick} from './parts.js';
import {counted, duration} from './words.js';

const PLACE = 'film';

export class FilmStep {
  title = 'Film';
  id = null; // of the film that is shown; null: none
  time = 0; // of the image that is shown [s]
  #video = null; // the element, or an image where the browser cannot play the film
  #playable = true;
  #lines = new Map(); // film -> {of, line, simulated}
  #moved = null; // {k, edge, time} while an edge of a trial's block is dragged

  constructor(app) {
    this.app = app;
  }

  get entry() {
    return this.app.project.document.films.find((film) => film.id === this.id);
  }

  get seen() {
    return this.app.project.state.films[this.id];
  }

  /** Show a film, or where its last trial has ended. */
  open(id, ended = false) {
    if (id !== this.id) {
      this.id = id;
      this.time = 0;
      this.#playable = true;
      this.#video = document.createElement('video');
      Object.assign(this.#video, {muted: true, playsInline: true, preload: 'auto'});
      this.#video.src = `api/films/${id}/video`;
      this.#video.onerror = () => this.#fallBack();
      this.#video.ontimeupdate = () => this.#at(this.#video.currentTime);
      this.#video.onpause = () => this.app.refresh();
      this.#video.onplay = () => this.#follow();
    }
    if (ended) this.#seek(this.#end);
    this.app.refresh();
  }

  /** @returns {number} when the last trial has ended [s] */
  get #end() {
    return this.seen.trials?.at(-1)?.end ?? 0;
  }

  /** @returns {boolean} whether the DLO is shown as the last trial has left it */
  get #ended() {
    return this.time > this.#end - this.#half;
  }

  /** @returns {number} how far an image may be from a time to be the one of that time [s] */
  get #half() {
    return 0.6 / (this.seen.frame_rate ?? 30);
  }

  close() {
    this.#video?.pause?.();
    this.id = null;
  }

  /** @returns {HTMLElement} what shows the image */
  get picture() {
    return this.#video;
  }

  /** Show images from the server where the browser cannot play the film. */
  #fallBack() {
    this.#playable = false;
    this.#video = new Image();
    this.#video.alt = '';
    this.#video.src = `api/films/${this.id}/frame?time=${this.time.toFixed(4)}`;
    this.app.view.unsettle();
    this.app.refresh();
  }

  #at(time) {
    if (Math.abs(time - this.time) < 1e-4) return;
    this.time = time;
    this.app.refresh();
  }

  /** Draw the line of each image while the film plays. */
  #follow() {
    const video = this.#video;
    const next = (_, {mediaTime}) => {
      this.#at(mediaTime);
      if (!video.paused) video.requestVideoFrameCallback(next);
    };
    video.requestVideoFrameCallback?.(next);
    this.app.refresh();
  }

  #seek(time) {
    this.time = Math.min(Math.max(time, 0), this.seen.duration ?? 0);
    if (this.#playable) {
      this.#video.pause();
      this.#video.currentTime = this.time;
    } else this.#video.src = `api/films/${this.id}/frame?time=${this.time.toFixed(4)}`;
    this.app.refresh();
  }

  what() {
    return 'Click along the DLO in one image of the film, from one end to the other, once at each bend. Then let the page follow it.';
  }

  missing() {
    return [];
  }

  done() {
    return Boolean(this.seen?.trials?.length);
  }

  clicks() {
    return true;
  }

  /** @returns {number} index of the clicks in the image that is shown; -1: there are none */
  get #mark() {
    return this.entry.marks.findIndex(({time}) => Math.abs(time - this.time) < this.#half);
  }

  panel() {
    const {entry, seen} = this;
    const {app} = this;
    if (!entry || !seen) return [];
    const enough = entry.marks.some(({clicks}) => clicks.length > 1);
    const {progress} = seen;
    const here = this.#mark;
    return [
      h('h3', {}, entry.name),
      problem(app.project, PLACE),
      seen.problem ? h('p.problem', {role: 'alert'}, seen.problem) : null,
      h(
        'p',
        {role: 'status'},
        here < 0
          ? entry.marks.length
            ? `Clicks are in the ${entry.marks.length > 1 ? 'images' : 'image'} at ${entry.marks.map(({time}) => `${time.toFixed(2)} s`).join(', ')}. Where the line is wrong, click along the DLO in the first wrong image: that mends it and what follows.`
            : 'No clicks yet. Begin at one end of the DLO; the printed board must lie beside it.'
          : `${counted(entry.marks[here].clicks.length, 'click')} in this image.`,
      ),
      h(
        'div.row',
        {},
        button('Follow the DLO', () => this.#ask(), {
          class: !seen.trials || seen.outdated ? 'primary' : null,
          disabled: !enough || Boolean(progress) || seen.waiting,
        }),
        button('Remove the clicks of this image', () => this.#setMarks((marks) => marks.filter((_, k) => k !== here)), {
          disabled: here < 0,
        }),
      ),
      progress || seen.waiting ? this.#progress(progress) : null,
      advised(app, this.#ended ? this.id : null),
      seen.trials ? this.#outcome(seen) : null,
      h(
        'details',
        {key: 'held'},
        h('summary', {}, 'A hand without a tag'),
        h(
          'p.note',
          {},
          'Hands that wear a tag of the printed sheet are found by themselves. Else say where on the DLO the hand holds it, and how high.',
        ),
        entry.held.map((held, k) =>
          h(
            'div.row',
            {key: k},
            numeric({
              label: 'Place along the DLO',
              unit: '%',
              factor: 100,
              minimum: 0,
              maximum: 1,
              value: held.place,
              onset: (value) => this.#setHeld(k, {place: value}),
            }),
            numeric({
              label: 'Height',
              unit: 'mm',
              factor: 1000,
              minimum: 0,
              maximum: 2,
              value: held.height,
              onset: (value) => this.#setHeld(k, {height: value}),
            }),
            button('Remove', () => this.#edit((film) => film.held.splice(k, 1)), {
              'aria-label': `Remove hand ${k + 1}`,
            }),
          ),
        ),
        button('Add a hand', () => this.#edit((film) => film.held.push({place: 0, height: 0}))),
      ),
      this.#dlo(),
    ];
  }

  #dlo() {
    const {app} = this;
    return numeric({
      label: 'Mass of the DLO',
      unit: 'g',
      factor: 1000,
      minimum: 0,
      maximum: 1000,
      value: app.project.document.dlo.mass,
      key: 'mass',
      onset: (value) =>
        app.project.edit(
          (now) => {
            now.dlo.mass = value ?? 0;
          },
          {place: PLACE},
        ),
    });
  }

  async #ask() {
    await this.app.project.ask(`films/${this.id}/follow`, {place: PLACE});
  }

  #progress(progress) {
    if (!progress) return h('p.busy', {role: 'status'}, 'It begins in a moment …');
    const {done, images, left} = progress;
    return h(
      'div',
      {key: 'progress'},
      h('progress', {max: images, value: done, 'aria-label': 'Images that are done'}),
      h(
        'p.busy',
        {role: 'status'},
        `Image ${done} of about ${images}${left === null ? '' : `, ${duration(left)} left`}`,
      ),
    );
  }

  #outcome(seen) {
    const lost = seen.images - seen.tracked;
    return h(
      'section',
      {key: 'outcome', 'aria-label': 'Trials of the film'},
      h('h3', {}, 'Trials'),
      h(
        'p',
        {},
        `The DLO was followed through ${counted(seen.tracked, 'image')}`,
        lost ? `, and lost in ${lost}` : '',
        seen.outdated ? '. The clicks have changed since: follow it again.' : '.',
      ),
      seen.trials.length ? null : h('p.problem', {}, 'No movement of the DLO by a hand was found.'),
      seen.cutting ? h('p.busy', {role: 'status'}, 'The trials are cut anew …') : null,
      seen.trials.map((trial, k) =>
        h(
          'fieldset.trialcard',
          {key: k},
          h('legend', {}, this.#title(k)),
          h('p.note', {}, `${trial.start.toFixed(1)} to ${trial.end.toFixed(1)} s, ${counted(trial.goals, 'chain')}`),
          trial.hands.map((hand) =>
            h(
              'p',
              {},
              `${hand.name.replace('_', ' ')} holds the DLO at ${Math.round(100 * hand.place)} % of its length, from ${hand.closes.toFixed(1)} to ${hand.opens.toFixed(1)} s.`,
            ),
          ),
          h(
            'label.field.tall',
            {},
            h('span', {}, 'Name'),
            h('input', {
              type: 'text',
              maxlength: 100,
              value: this.#changes(k).name,
              onchange: (event) => this.#change(k, {name: event.target.value.trim()}),
            }),
          ),
          h(
            'div.row',
            {},
            tick({
              label: 'Use this trial',
              checked: this.#changes(k).used,
              onset: (used) => this.#change(k, {used}),
            }),
            button('Show', () => this.#seek(trial.start)),
          ),
        ),
      ),
      seen.problems.length
        ? h(
            'ul.warnings',
            {},
            seen.problems.map((text) => h('li.warning', {}, text)),
          )
        : null,
    );
  }

  drawn() {
    const {entry, seen} = this;
    const here = this.#mark;
    const {pixels, simulated} = this.#shown();
    return [
      ...pieces(pixels).map((piece, k) => line(piece, seen.outdated ? 'before' : 'sure', `piece${k}`)),
      simulated ? line(simulated, 'simulated', 'simulated') : null,
      ...(this.#ended ? arrows(this.app, this.id) : []),
      ...(here < 0 ? [] : entry.marks[here].clicks).map((at, k) =>
        mark({
          name: `click ${k}`,
          at,
          kind: 'click',
          text: String(k + 1),
          label: `Click ${k + 1}. Delete removes it.`,
        }),
      ),
    ];
  }

  /** @returns {{pixels: Array, simulated: Array | null}} the lines of the image that is shown */
  #shown() {
    const {seen} = this;
    const none = {pixels: [], simulated: null};
    if (!seen.trials) return none;
    const {result, state} = this.app.project.state.calibration;
    const usable = result && !result.outdated && state !== 'calibrating';
    const of = JSON.stringify([seen.images, seen.trials, usable ? result.parameters : null]);
    const known = this.#lines.get(this.id);
    if (known?.of !== of) {
      this.#lines.set(this.id, {of, line: known?.line ?? null, simulated: null});
      this.#fetch(this.id, of, usable);
    }
    const {line: seenLine, simulated} = this.#lines.get(this.id);
    const k = seenLine ? nearest(seenLine.times, this.time) : -1;
    const i = simulated ? nearest(simulated.times, this.time) : -1;
    return {
      pixels: k < 0 ? [] : seenLine.pixels[k],
      simulated: i < 0 || Math.abs(simulated.times[i] - this.time) > 0.1 ? null : simulated.pixels[i],
    };
  }

  async #fetch(id, of, usable) {
    const {project} = this.app;
    const get = (what) => project.ask(`films/${id}/${what}`, {method: 'GET', place: PLACE});
    const seenLine = await get('line');
    const simulated = usable ? await get('simulated') : null;
    if (this.#lines.get(id)?.of === of) this.#lines.set(id, {of, line: seenLine, simulated});
    this.app.refresh();
  }

  player() {
    const {seen} = this;
    if (!seen?.duration) return [];
    const playing = this.#playable && !this.#video.paused;
    const {simulated} = this.#shown();
    return [
      h(
        'div.controls.film',
        {key: 'film', role: 'group', 'aria-label': 'Film'},
        this.#playable
          ? h(
              'button',
              {
                type: 'button',
                'aria-label': playing ? 'Pause' : 'Play',
                onclick: () => (playing ? this.#video.pause() : this.#video.play()),
              },
              playing ? '❚❚' : '▶',
            )
          : null,
        h(
          'div.timeline',
          {},
          h('input', {
            type: 'range',
            min: 0,
            max: seen.duration,
            step: 1 / (seen.frame_rate ?? 30),
            value: String(this.time),
            'aria-label': 'Time of the film',
            'aria-valuetext': `${this.time.toFixed(2)} seconds`,
            oninput: (event) => this.#seek(Number(event.target.value)),
          }),
          seen.trials?.length ? this.#blocks() : null,
        ),
        h('output', {}, `${this.time.toFixed(2)} s`),
      ),
      this.#playable
        ? null
        : h('span.note', {}, 'This browser cannot play the film; move the slider to see its images.'),
      legend(
        [
          ['mark click', 'your click'],
          seen.trials ? ['sure', 'the DLO as followed'] : null,
          simulated ? ['simulated', 'simulated'] : null,
        ].filter(Boolean),
      ),
    ];
  }

  /** @returns {[number, number]} from when to when hands hold the DLO in a trial [s] */
  #holds(k) {
    const {hands} = this.seen.trials[k];
    return [Math.min(...hands.map(({closes}) => closes)), Math.max(...hands.map(({opens}) => opens))];
  }

  /** @returns {object} what the person changed about a trial */
  #changes(k) {
    const [closes, opens] = this.#holds(k);
    const known = this.entry.trials.find(({at}) => closes <= at && at <= opens);
    return known ?? {at: (closes + opens) / 2, start: null, end: null, name: '', used: true};
  }

  #change(k, change, merge = null) {
    const changes = this.#changes(k);
    this.#edit((film) => {
      film.trials = film.trials.filter(({at}) => at !== changes.at);
      film.trials.push({...changes, ...change});
      film.trials.sort((a, b) => a.at - b.at);
    }, merge);
  }

  #title(k) {
    const {name} = this.#changes(k);
    return name || `Trial ${k + 1}`;
  }

  #blocks() {
    const {duration, frame_rate: rate, trials} = this.seen;
    const moved = this.#moved;
    const blocks = trials.map((trial, k) => {
      const changes = this.#changes(k);
      const at = (edge) => (moved?.k === k && moved.edge === edge ? moved.time : (changes[edge] ?? trial[edge]));
      return {
        title: this.#title(k),
        used: changes.used,
        start: at('start'),
        end: at('end'),
        limits: {
          start: [trials[k - 1]?.earliest_end ?? 0, trial.latest_start],
          end: [trial.earliest_end, trials[k + 1]?.latest_start ?? duration],
        },
      };
    });
    return timeBlocks({
      duration,
      step: 1 / (rate ?? 30),
      blocks,
      onshow: (k) => this.#seek(blocks[k].start),
      onuse: (k, used) => this.#change(k, {used}),
      onmove: (k, edge, time) => {
        this.#moved = {k, edge, time};
        this.#seek(time);
      },
      onmoved: () => {
        const {k, edge, time} = this.#moved ?? {};
        this.#moved = null;
        if (edge) this.#change(k, {[edge]: time}, `edge ${edge} ${k}`);
      },
    });
  }

  tap(pixel) {
    if (this.#playable) this.#video.pause();
    const here = this.#mark;
    this.#setMarks((marks) =>
      here < 0
        ? [...marks, {time: this.time, clicks: [pixel]}]
        : marks.map((own, k) => (k === here ? {...own, clicks: [...own.clicks, pixel]} : own)),
    );
    this.app.say('Click added');
  }

  grab(name) {
    const k = Number(name.split(' ')[1]);
    const merge = `drag ${name} ${Date.now()}`;
    const here = this.#mark;
    return {
      move: (at) => this.#setClicks(here, (clicks) => clicks.map((click, i) => (i === k ? at : click)), merge),
      end: () => this.app.project.settle(),
    };
  }

  nudge(name, by) {
    const k = Number(name.split(' ')[1]);
    this.#setClicks(
      this.#mark,
      (clicks) => clicks.map(([u, v], i) => (i === k ? [u + by[0], v + by[1]] : [u, v])),
      `nudge ${name}`,
    );
  }

  press(name, key) {
    if (key !== 'Delete' && key !== 'Backspace') return false;
    const k = Number(name.split(' ')[1]);
    this.#setClicks(this.#mark, (clicks) => clicks.filter((_, i) => i !== k));
    return true;
  }

  #setClicks(which, change, merge = null) {
    this.#setMarks(
      (marks) =>
        marks
          .map((own, k) => (k === which ? {...own, clicks: change(own.clicks)} : own))
          .filter(({clicks}) => clicks.length),
      merge,
    );
  }

  #setMarks(change, merge = null) {
    this.#edit((film) => {
      film.marks = change(film.marks).sort((a, b) => a.time - b.time);
    }, merge);
  }

  #setHeld(k, change) {
    this.#edit((film) => {
      film.held[k] = {...film.held[k], ...change};
    });
  }

  #edit(change, merge = null) {
    const {id} = this;
    this.app.project.edit((now) => change(now.films.find((film) => film.id === id)), {merge, place: PLACE});
  }
}

/** @returns {Array} the parts of a line that were seen */
function pieces(pixels) {
  const parts = [[]];
  for (const pixel of pixels)
    if (pixel) parts.at(-1).push(pixel);
    else if (parts.at(-1).length) parts.push([]);
  return parts.filter((part) => part.length > 1);
}

/** @returns {number} index of the nearest of increasing times; -1: there is none */
function nearest(times, time) {
  let low = 0;
  let high = times.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < time) low = middle + 1;
    else high = middle;
  }
  return low > 0 && time - times[low - 1] < times[low] - time ? low - 1 : times.length ? low : -1;
}
