// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Step 1, photographs: their files, and the start and goal of each trial. */

import {advised} from './advice.js';
import {openCamera} from './camera.js';
import {HANGING} from './clamps.js';
import {h} from './dom.js';
import {dropped} from './dropped.js';
import {introduction} from './introduction.js';
import {button, choice, files, problem, tick} from './parts.js';
import {address} from './picture.js';
import {counted} from './words.js';

const ACCEPT = 'image/jpeg,image/png,video/*,.jpg,.jpeg,.png,.mp4,.mov,.webm,.mkv,.avi';
const FILM = /\.(mp4|m4v|mov|webm|mkv|avi|3gp)$/i;
const PHOTOGRAPH = /\.(jpe?g|png|heic|heif|avif|webp|tiff?|bmp|gif)$/i; // the server refuses some, and says why
const PLACE = 'photographs';
const SLOTS = {start: 'Start: before the hand moves', goal: 'Goal: when the DLO lies still again'};
const SIDES = {start_side: 'Start, seen from the side', goal_side: 'Goal, seen from the side'};

export class PhotographsStep {
  title = 'Photographs';
  adding = 0; // photographs on their way to the server
  #refusals = [];
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
    const {films, photographs, trials} = this.app.project.document;
    if (!photographs.length) return films.length ? [] : ['two photographs, one of a DLO that hangs, or a film'];
    return trials.flatMap((trial, k) => (trial.goal || this.app.hangs(trial) ? [] : [`the goal photograph of trial ${k + 1}`]));
  }

  done() {
    const {films, trials} = this.app.project.document;
    return trials.length + films.length > 0 && trials.every((trial) => trial.goal || this.app.hangs(trial));
  }

  /** Add files, one after the other. */
  async add(chosen) {
    this.#refusals = [];
    const wanted = chosen.length === 1 ? chosen : chosen.filter((file) => PHOTOGRAPH.test(file.name) || FILM.test(file.name));
    if (chosen.length && !wanted.length)
      this.#refusals.push('There is no photograph or film among these files: add JPEG, PNG or mp4 files.');
    const {app} = this;
    const before = new Set(app.project.document.photographs.map((photograph) => photograph.id));
    let opened = null; // the newest film
    this.adding += wanted.length;
    if (app.step || app.film.id) app.go(0);
    for (const file of wanted) {
      app.say(`${file.name} is being added`);
      app.refresh();
      const film = FILM.test(file.name);
      const answer = await app.project.ask(film ? 'films' : 'photographs', {
        body: file,
        name: file.name,
        place: PLACE,
      });
      this.adding -= 1;
      if (answer && film) opened = answer.id;
      else if (answer) this.#last = answer.id;
      else {
        this.#refusals.push(app.project.problem.text);
        app.project.clear();
      }
    }
    app.trial = Math.max(
      0,
      app.project.document.trials.findIndex((trial) => !before.has(trial.goal ?? trial.start)),
    );
    app.say(this.adding ? '' : 'All photographs are added');
    if (opened && !this.adding) app.openFilm(opened);
    app.refresh();
  }

  panel() {
    const {document: {films, photographs, trials}, state} = this.app.project;
    const some = photographs.length > 0;
    return [
      some || films.length ? null : introduction(),
      h(
        'div.drop',
        {},
        h(
          'p',
          {},
          h('strong', {}, 'Drop photographs or a film here'),
          ' or anywhere on the page: JPEG or PNG, the first one before the hand moves; or a film (mp4, mov, webm, mkv) of the DLO before, while and after hands move it.',
        ),
        h(
          'div.row',
          {},
          files({
            text: 'Choose photographs or a film …',
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
        h(
          'p.busy',
          {role: 'status'},
          this.adding ? `${counted(this.adding, 'photograph is', 'photographs are')} being added …` : '',
        ),
        h(
          'div',
          {role: 'alert'},
          this.#refusals.map((text) => h('p.problem', {}, text)),
        ),
        problem(this.app.project, PLACE),
      ),
      advised(this.app),
      films.length
        ? h(
            'section',
            {'aria-label': 'Films'},
            h('h3', {}, 'Films'),
            h(
              'ul.photographs',
              {},
              films.map((film) => this.#film(film)),
            ),
          )
        : null,
      some
        ? h(
            'section',
            {'aria-label': 'Trials'},
            h('h3', {}, 'Trials'),
            h(
              'p.note',
              {},
              'A trial is one movement of the hands, with a photograph before and after it. ' +
                'More trials with different movements make the result more certain.',
            ),
            trials.map((trial, k) => this.#trial(trial, k)),
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
              photographs.map((photograph) => this.#photograph(photograph)),
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
      this.#topics.map((topic) =>
        h(
          'li',
          {key: topic.name},
          h('code', {}, topic.name),
          ' ',
          button(
            'Take an image',
            async () => {
              this.adding += 1;
              this.app.refresh();
              await this.app.project.ask('topics', {body: {name: topic.name}, place: PLACE});
              this.adding -= 1;
              this.app.refresh();
            },
            {'aria-label': `Take an image of ${topic.name}`},
          ),
        ),
      ),
    );
  }

  #trial(trial, k) {
    const sides = Object.keys(SIDES).some((role) => trial[role]);
    const hanging = this.app.hangs(trial);
    const hangs = tick({
      label: 'It hangs between two clamps, at rest: one photograph is a whole trial',
      checked: hanging,
      key: 'hangs',
      onset: (value) => this.#hang(trial, k, value),
    });
    if (hanging)
      return h(
        'fieldset.trialcard',
        {key: k},
        h('legend', {}, `Trial ${k + 1}`),
        h('div.slots', {}, this.#slot(trial, k, 'start', 'The DLO between the clamps')),
        hangs,
        h('div.row', {}, this.#removal(k)),
      );
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
          'A photograph from above does not show how high the DLO hangs. A second one, taken from the side at the ' +
            'same moment, shows it; it needs a scale, too.',
        ),
        h(
          'div.slots',
          {},
          Object.entries(SIDES).map(([role, text]) => this.#slot(trial, k, role, text)),
        ),
      ),
      hangs,
      h(
        'div.row',
        {},
        button(
          'Swap start and goal',
          () =>
            this.#change((now) => {
              const swapped = now.trials[k];
              [swapped.start, swapped.goal] = [swapped.goal, swapped.start];
              [swapped.start_side, swapped.goal_side] = [swapped.goal_side, swapped.start_side];
            }),
          {disabled: !trial.goal},
        ),
        this.#removal(k),
      ),
    );
  }

  #removal(k) {
    return button(
      'Remove trial',
      () =>
        this.#change((now) => {
          now.trials.splice(k, 1);
        }),
      {'aria-label': `Remove trial ${k + 1}`},
    );
  }

  /** Make the start of a trial a photograph of a DLO that hangs, or not; a goal hangs in a trial of its own. */
  #hang(trial, k, value) {
    const alone = {goal: null, start_side: null, goal_side: null, steps: []};
    this.#change((now) => {
      const set = (id) => {
        now.photographs.find((photograph) => photograph.id === id).scale = value ? {...HANGING, clamps: []} : null;
      };
      set(trial.start);
      if (!value) return;
      Object.assign(now.trials[k], alone);
      if (!trial.goal || now.trials.some(({start}) => start === trial.goal)) return;
      set(trial.goal);
      now.trials.splice(k + 1, 0, {start: trial.goal, ...alone});
    });
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
          ...photographs.map((photograph) => [photograph.id, photograph.name]),
        ],
        onset: (value) =>
          this.#change((now) => {
            now.trials[k][role] = value || null;
          }),
      }),
    );
  }

  #photograph(photograph) {
    const {app} = this;
    const seen = app.project.seen(photograph.id);
    const places = app
      .used(false)
      .filter(([, , id]) => id === photograph.id)
      .map(([k, role]) => app.placed(k, role));
    return h(
      'li',
      {key: photograph.id, class: photograph.id === this.#last ? 'latest' : null},
      h('img', {src: address(photograph.id, 320), alt: '', loading: 'lazy'}),
      h(
        'div',
        {},
        h('strong', {}, photograph.name),
        h('span.note', {}, seen ? `${seen.width} × ${seen.height} pixels` : ''),
        h('span.note', {}, places.length ? places.join(', ') : 'not used yet'),
        seen?.problem ? h('p.problem', {}, seen.problem) : null,
      ),
      button('Remove', () => this.#remove(photograph.id), {
        'aria-label': `Remove the photograph ${photograph.name}`,
      }),
    );
  }

  #film(film) {
    const {app} = this;
    const seen = app.project.state.films[film.id];
    const used = (seen?.trials ?? []).filter((trial) => trial.used).length;
    return h(
      'li',
      {key: film.id},
      h('img', {src: `api/films/${film.id}/frame`, alt: '', loading: 'lazy'}),
      h(
        'div',
        {},
        h('strong', {}, film.name),
        h(
          'span.note',
          {},
          seen?.duration ? `${seen.width} × ${seen.height} pixels, ${seen.duration.toFixed(1)} s` : '',
        ),
        h(
          'span.note',
          {},
          seen?.trials
            ? counted(used, 'trial')
            : seen?.progress
              ? 'The DLO is being followed …'
              : 'Open it, and click along the DLO.',
        ),
        seen?.problem ? h('p.problem', {}, seen.problem) : null,
      ),
      button('Open', () => app.openFilm(film.id), {'aria-label': `Open the film ${film.name}`}),
      button(
        'Remove',
        () =>
          this.#change((now) => {
            now.films = now.films.filter((other) => other.id !== film.id);
          }),
        {'aria-label': `Remove the film ${film.name}`},
      ),
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
      now.photographs = now.photographs.filter((photograph) => photograph.id !== id);
      for (const photograph of now.photographs)
        if (photograph.scale?.photograph === id) photograph.scale = null;
      now.obstacles = now.obstacles.filter((obstacle) => obstacle.photograph !== id);
      now.trials = now.trials.filter((trial) => trial.start !== id);
      for (const trial of now.trials)
        for (const role of ['goal', 'start_side', 'goal_side']) if (trial[role] === id) trial[role] = null;
    });
  }

  #change(change) {
    this.app.project.edit(change, {place: PLACE});
  }
}
