// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Step 1, photographs: their files, and which is the start and the goal of which trial. */

import {openCamera} from './camera.js';
import {h} from './dom.js';
import {dropped} from './dropped.js';
import {introduction} from './introduction.js';
import {button, choice, files, problem} from './parts.js';
import {address} from './picture.js';

const ACCEPT = 'image/jpeg,image/png,.jpg,.jpeg,.png';
const PHOTOGRAPH = /\.(jpe?g|png|heic|heif|avif|webp|tiff?|bmp|gif)$/i; // the server explains which of them it refuses
const PLACE = 'photographs';
const SLOTS = {start: 'Start: before the hand moves', goal: 'Goal: when the DLO lies still again'};
const SIDES = {start_side: 'Start, seen from the side', goal_side: 'Goal, seen from the side'};

export class PhotographsStep {
  title = 'Photographs';
  #coming = 0;
  #refused = [];
  #topics = null;
  #last = null; // the newest photograph

  constructor(app) {
    this.app = app;
    const {body} = document;
    body.addEventListener('dragover', (event) => {
      if (![...event.dataTransfer.types].includes('Files')) return;
      event.preventDefault();
      body.classList.add('dropping');
    });
    body.addEventListener('dragleave', (event) => {
      if (!event.relatedTarget) body.classList.remove('dropping');
    });
    body.addEventListener('drop', async (event) => {
      event.preventDefault();
      body.classList.remove('dropping');
      await this.add(await dropped(event.dataTransfer));
    });
  }

  what() {
    return 'Add a photograph of the DLO (your rope, cable, wire or hose) before a hand moves it, and one after.';
  }

  missing() {
    const {photographs, trials} = this.app.project.document;
    if (!photographs.length) return ['two photographs'];
    return trials.flatMap((trial, k) => (trial.goal ? [] : [`the goal photograph of trial ${k + 1}`]));
  }

  done() {
    const {trials} = this.app.project.document;
    return trials.length > 0 && trials.every((one) => one.goal);
  }

  /** Add files, one after the other. */
  async add(chosen) {
    this.#refused = [];
    const wanted = chosen.length === 1 ? chosen : chosen.filter((file) => PHOTOGRAPH.test(file.name));
    if (chosen.length && !wanted.length)
      this.#refused.push('There is no photograph among these files: add JPEG or PNG files.');
    const {app} = this;
    const before = new Set(app.project.document.photographs.map((one) => one.id));
    this.#coming += wanted.length;
    if (app.step) app.go(0);
    for (const file of wanted) {
      app.say(`${file.name} is being added`);
      app.refresh();
      const answer = await app.project.ask('photographs', {body: file, name: file.name, place: PLACE});
      this.#coming -= 1;
      if (answer) this.#last = answer.id;
      else {
        this.#refused.push(app.project.problem.text);
        app.project.clear();
      }
    }
    app.trial = Math.max(
      0,
      app.project.document.trials.findIndex((one) => !before.has(one.goal ?? one.start)),
    );
    app.say(this.#coming ? '' : 'All photographs are there');
    app.refresh();
  }

  panel() {
    const {document: kept, state} = this.app.project;
    const some = kept.photographs.length > 0;
    return [
      some ? null : introduction(),
      h(
        'div.drop',
        {},
        h(
          'p',
          {},
          h('strong', {}, 'Drop photographs here'),
          ' or anywhere on the page: JPEG or PNG, the first one before the hand moves.',
        ),
        h(
          'div.row',
          {},
          files({
            text: 'Choose photographs …',
            accept: ACCEPT,
            multiple: true,
            primary: !some,
            onfiles: (chosen) => this.add(chosen),
          }),
          files({
            text: 'Choose a folder …',
            folder: true,
            multiple: true,
            onfiles: (chosen) =>
              this.add(chosen.sort((a, b) => a.name.localeCompare(b.name, undefined, {numeric: true}))),
          }),
          button('Use this computer’s camera …', () => openCamera((file) => this.add([file]))),
          state.ros ? button('Take from a ROS topic …', () => this.#list()) : null,
        ),
        this.#topics ? this.#chooser() : null,
        h('p.busy', {role: 'status'}, this.#coming ? `${this.#coming} to be added …` : ''),
        h(
          'div',
          {role: 'alert'},
          this.#refused.map((text) => h('p.problem', {}, text)),
        ),
        problem(this.app.project, PLACE),
      ),
      some
        ? h(
            'section',
            {'aria-label': 'Trials'},
            h('h3', {}, 'Trials'),
            h(
              'p.note',
              {},
              'A trial is one movement of the hands: a photograph before, and one after it. ' +
                'More trials with different movements give a more certain result.',
            ),
            kept.trials.map((trial, k) => this.#trial(trial, k)),
            button('Add a trial', () => this.#addTrial()),
          )
        : null,
      some
        ? h(
            'section',
            {'aria-label': 'All photographs'},
            h('h3', {}, 'All photographs'),
            h(
              'ul.photographs',
              {},
              kept.photographs.map((one) => this.#photograph(one)),
            ),
          )
        : null,
    ];
  }

  async #list() {
    const answer = await this.app.project.ask('topics', {method: 'GET', place: PLACE});
    if (answer) this.#topics = answer.topics;
    this.app.refresh();
  }

  #chooser() {
    if (!this.#topics.length)
      return h(
        'p.problem',
        {},
        'No node publishes images at the moment: start the camera’s node, then try again.',
      );
    return h(
      'ul.topics',
      {},
      this.#topics.map((one) =>
        h(
          'li',
          {key: one.name},
          h('code', {}, one.name),
          ' ',
          button(
            'Take an image',
            async () => {
              this.#coming += 1;
              this.app.refresh();
              await this.app.project.ask('topics', {body: {name: one.name}, place: PLACE});
              this.#coming -= 1;
              this.app.refresh();
            },
            {'aria-label': `Take an image of ${one.name}`},
          ),
        ),
      ),
    );
  }

  #trial(trial, k) {
    const sides = Object.keys(SIDES).some((role) => trial[role]);
    return h(
      'fieldset.trialcard',
      {key: k},
      h('legend', {}, `Trial ${k + 1}`),
      h(
        'div.slots',
        {},
        Object.entries(SLOTS).map(([role, text]) => this.#slot(trial, k, role, text)),
      ),
      h(
        'details',
        {open: sides},
        h('summary', {}, 'The DLO was lifted: photographs from the side'),
        h(
          'p.note',
          {},
          'From above, one cannot see how high the DLO hangs. A second photograph of the same moment from the side ' +
            'shows it; it needs a scale, too.',
        ),
        h(
          'div.slots',
          {},
          Object.entries(SIDES).map(([role, text]) => this.#slot(trial, k, role, text)),
        ),
      ),
      h(
        'div.row',
        {},
        button(
          'Swap start and goal',
          () =>
            this.#change((now) => {
              const one = now.trials[k];
              [one.start, one.goal] = [one.goal, one.start];
              [one.start_side, one.goal_side] = [one.goal_side, one.start_side];
            }),
          {disabled: !trial.goal},
        ),
        button(
          'Remove trial',
          () =>
            this.#change((now) => {
              now.trials.splice(k, 1);
            }),
          {'aria-label': `Remove trial ${k + 1}`},
        ),
      ),
    );
  }

  #slot(trial, k, role, text) {
    const {photographs} = this.app.project.document;
    const id = trial[role];
    return h(
      'div.slot',
      {key: role},
      id ? h('img', {src: address(id, 320), alt: ''}) : h('div.none', {'aria-hidden': 'true'}, '?'),
      choice({
        label: text,
        value: id ?? '',
        key: 'choice',
        choices: [
          ...(role === 'start' ? [] : [['', 'none yet']]),
          ...photographs.map((one) => [one.id, one.name]),
        ],
        onset: (value) =>
          this.#change((now) => {
            now.trials[k][role] = value || null;
          }),
      }),
    );
  }

  #photograph(one) {
    const {app} = this;
    const seen = app.project.seen(one.id);
    const places = app
      .used(false)
      .filter(([, , id]) => id === one.id)
      .map(([k, role]) => app.placed(k, role));
    return h(
      'li',
      {key: one.id, class: one.id === this.#last ? 'latest' : null},
      h('img', {src: address(one.id, 320), alt: '', loading: 'lazy'}),
      h(
        'div',
        {},
        h('strong', {}, one.name),
        h('span.note', {}, seen ? `${seen.width} × ${seen.height} pixels` : ''),
        h('span.note', {}, places.length ? places.join(', ') : 'not used yet'),
        seen?.problem ? h('p.problem', {}, seen.problem) : null,
      ),
      button('Remove', () => this.#remove(one.id), {'aria-label': `Remove the photograph ${one.name}`}),
    );
  }

  #addTrial() {
    const {trials, photographs} = this.app.project.document;
    const last = trials.at(-1);
    this.#change((now) =>
      now.trials.push({
        start: last?.goal ?? last?.start ?? photographs[0].id,
        goal: null,
        start_side: null,
        goal_side: null,
        steps: [],
      }),
    );
  }

  #remove(id) {
    this.#change((now) => {
      now.photographs = now.photographs.filter((one) => one.id !== id);
      for (const one of now.photographs) if (one.scale?.photograph === id) one.scale = null;
      now.trials = now.trials.filter((one) => one.start !== id);
      for (const one of now.trials)
        for (const role of ['goal', 'start_side', 'goal_side']) if (one[role] === id) one[role] = null;
    });
  }

  #change(change) {
    this.app.project.edit(change, {place: PLACE});
  }
}
