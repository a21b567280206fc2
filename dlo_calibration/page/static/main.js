// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The page: which step, trial and photograph is shown, and what all steps share. */

import {CalibrationStep} from './calibration.js';
import {hangs} from './clamps.js';
import {h, patch} from './dom.js';
import {FilmStep} from './filming.js';
import {listen} from './gestures.js';
import {HandsStep} from './hands.js';
import {button} from './parts.js';
import {PhotographsStep} from './photographs.js';
import {address} from './picture.js';
import {Player} from './player.js';
import {Project} from './project.js';
import {ScaleStep} from './scale.js';
import {TraceStep} from './trace.js';
import {View} from './view.js';
import {counted} from './words.js';

const ROLES = {
  start: 'Start',
  goal: 'Goal',
  start_side: 'Start from the side',
  goal_side: 'Goal from the side',
};
const of = (id) => document.getElementById(id);

class App {
  project = new Project();
  view = new View(of('stage'));
  step = 0;
  trial = 0;
  role = 'start';
  #asked = false;
  #fit = false; // the next drawing shows the whole photograph

  constructor() {
    this.player = new Player(() => this.refresh());
    this.photographs = new PhotographsStep(this);
    this.film = new FilmStep(this);
    this.steps = [
      this.photographs,
      new ScaleStep(this),
      new TraceStep(this),
      new HandsStep(this),
      new CalibrationStep(this),
    ];
    const go = (step, text) => ({step, text, act: () => this.go(step)});
    this.remedies = {
      // by the names that the server gives them; `step`: where its warning is shown
      add_goal: go(0, 'Go to the photographs'),
      add_side: go(0, 'Go to the photographs'),
      set_scale: go(1, 'Go to the scale'),
      add_click: go(2, 'Go to the DLO'),
      check_length: go(2, 'Go to the DLO'),
      more_points: go(2, 'Go to the DLO'),
      add_step: go(3, 'Go to the hands'),
      ask_crossings: {step: 2, text: 'Show the crossings', act: () => this.steps[2].ask()},
      reverse_goal: {
        step: 2,
        text: 'Reverse the order of the goal’s clicks',
        act: () => this.steps[2].reverse(this.entry.goal),
      },
      mark_place: {step: 3, text: 'Mark the place', act: () => this.steps[3].markPlace()},
    };
    listen(this.view, () => this.current);
    this.project.addEventListener('change', () => this.refresh());
    document.addEventListener('keydown', (event) => this.#keys(event));
  }

  /** Open the project, at the first step that is not done. */
  async open() {
    await this.project.open();
    const first = this.steps.findIndex((step, k) => !this.skips(k) && !step.done());
    this.go(first < 0 ? this.steps.length - 1 : first, false);
  }

  get current() {
    return this.film.id ? this.film : this.steps[this.step];
  }

  /** @returns {boolean} whether a step is of no use, since all trials are filmed */
  skips(step) {
    const {films, photographs} = this.project.document;
    return films.length > 0 && !photographs.length && step > 0 && step < this.steps.length - 1;
  }

  /** Show a film, in place of the steps. */
  openFilm(id, ended = false) {
    this.project.clear();
    this.film.open(id, ended);
    this.#fit = true;
    this.view.unsettle();
    this.refresh();
  }

  /** @returns {object | undefined} the trial that is worked on */
  get entry() {
    return this.project.document.trials[this.trial];
  }

  /** @returns {string | null} id of the photograph that is worked on */
  get id() {
    return this.entry?.[this.role] ?? null;
  }

  /** @returns {object | undefined} the photograph that is worked on, as in the document */
  get photograph() {
    return this.id ? this.project.photograph(this.id) : undefined;
  }

  /** @returns {object | undefined} what the server knows of it */
  get seen() {
    return this.id ? this.project.seen(this.id) : undefined;
  }

  /** @returns {boolean} whether the DLO of a trial hangs: its photograph is the whole trial */
  hangs(trial) {
    return Boolean(trial) && hangs(this.project.photograph(trial.start));
  }

  /** Go to a step. */
  go(step, focus = true) {
    this.step = step;
    this.film.close();
    this.player.stop();
    this.project.clear();
    const {role} = this.current;
    if (role && this.entry?.[role]) this.role = role;
    this.#fit = true;
    this.view.unsettle();
    this.refresh();
    if (focus)
      requestAnimationFrame(() => {
        of('panel').scrollTop = 0;
        of('title')?.focus({preventScroll: true});
      });
  }

  /** Work on a photograph of a trial. */
  choose(trial, role) {
    this.trial = trial;
    this.role = role;
    this.project.clear();
    this.view.unsettle();
    this.refresh();
  }

  /** List the photographs that are in trials: [trial, role, id], each id once where `once`. */
  used(once = true) {
    const places = [];
    this.project.document.trials.forEach((trial, k) =>
      Object.keys(ROLES).forEach((role) => {
        const id = trial[role];
        if (id && !(once && places.some((place) => place[2] === id))) places.push([k, role, id]);
      }),
    );
    return places;
  }

  /** @returns {string} a photograph's place in words, such as 'goal of trial 2' */
  placed(trial, role) {
    return `${ROLES[role].toLowerCase()} of trial ${trial + 1}`;
  }

  /** Announce something to screen readers. */
  say(text) {
    of('live').textContent = text;
  }

  /** Draw everything anew, once, before the next frame. */
  refresh() {
    if (this.#asked) return;
    this.#asked = true;
    requestAnimationFrame(() => {
      this.#asked = false;
      this.#render();
    });
  }

  #render() {
    const {state} = this.project;
    if (!state)
      return patch(of('panel'), [
        h(
          'p.what',
          {},
          this.project.connected
            ? 'The project is being opened …'
            : 'The server cannot be reached; this page keeps trying.',
        ),
      ]);
    this.trial = Math.max(0, Math.min(this.trial, this.project.document.trials.length - 1));
    if (!this.id) this.role = this.entry?.start ? 'start' : 'goal';
    if (this.film.id && !this.film.entry) this.film.close(); // it was removed
    const {current} = this;
    patch(of('top'), this.#top());
    const filming = current === this.film;
    const wide = !filming && (this.step === 0 || (this.skips(1) && !this.id));
    of('work').hidden = wide;
    of('main').className = wide ? 'wide' : '';
    patch(of('panel'), [h('div.panel', {key: current.title}, this.#panel())]);
    if (wide) return null;
    if (filming) return this.#showFilm();
    patch(of('strip'), this.#strip());
    const {seen} = this;
    this.view.show(seen ? this.id : null, seen ?? null);
    of('stage').setAttribute(
      'aria-label',
      seen
        ? `${this.photograph.name}, ${this.placed(this.trial, this.role)}. ` +
            'Arrow keys move the photograph, plus and minus zoom, 0 shows all of it, Enter clicks in its middle, ' +
            'Tab goes to the marks.'
        : 'No photograph',
    );
    of('stage').classList.toggle('clicks', Boolean(current.clicks?.()));
    this.view.draw(seen ? current.drawn() : [], seen ? (current.bubbles?.() ?? []) : [], seen?.trace?.pixels);
    patch(of('tools'), this.#tools());
    patch(of('player'), current.player?.() ?? []);
    if (this.#fit) this.view.fit();
    this.#fit = false;
    this.view.settle();
    return null;
  }

  #showFilm() {
    const {film} = this;
    const seen = film.seen?.width ? film.seen : null;
    patch(of('strip'), []);
    this.view.show(seen ? `film ${film.id}` : null, seen, film.picture);
    of('stage').setAttribute('aria-label', `${film.entry.name}. Click along the DLO.`);
    of('stage').classList.add('clicks');
    this.view.draw(seen ? film.drawn() : [], []);
    patch(of('tools'), this.#tools());
    patch(of('player'), film.player());
    if (this.#fit) this.view.fit();
    this.#fit = false;
    this.view.settle();
    return null;
  }

  #top() {
    const {project} = this;
    return [
      h(
        'h1',
        {},
        h('img', {src: 'page/icon.svg', alt: '', width: 26, height: 26}),
        h('span', {}, 'DLO calibration'),
        h('small', {title: project.state.folder}, project.state.folder.split('/').pop()),
      ),
      h(
        'nav',
        {'aria-label': 'Steps'},
        h(
          'ol.steps',
          {},
          this.steps.map((step, k) =>
            h(
              'li',
              {key: k, hidden: this.skips(k)},
              h(
                'button',
                {
                  type: 'button',
                  'aria-current': k === this.step && !this.film.id ? 'step' : null,
                  class: step.done() ? 'done' : null,
                  onclick: () => this.go(k),
                },
                h('span.number', {'aria-hidden': 'true'}, step.done() ? '✓' : String(k + 1)),
                h('span.name', {}, step.title),
                h('span.unseen', {}, step.done() ? ' (done)' : ' (open)'),
              ),
            ),
          ),
        ),
      ),
      h(
        'div.history',
        {},
        button('Undo', () => project.undo(), {disabled: !project.canUndo, title: 'Ctrl+Z'}),
        button('Redo', () => project.redo(), {disabled: !project.canRedo, title: 'Ctrl+Shift+Z'}),
      ),
      h(
        'div.messages',
        {role: 'status'},
        project.connected
          ? null
          : h(
              'p.lost',
              {},
              'The connection to the server is lost; this page tries again, and keeps what you do.',
            ),
        project.notice
          ? h(
              'p.notice',
              {},
              project.notice,
              button('OK', () => project.clear()),
            )
          : null,
        project.problem?.place === ''
          ? h(
              'p.problem',
              {},
              project.problem.text,
              button('OK', () => project.clear()),
            )
          : null,
      ),
    ];
  }

  #panel() {
    const {current} = this;
    const missing = current.missing();
    if (current === this.film) return this.#filmPanel();
    const following = this.steps.findIndex((_, k) => k > this.step && !this.skips(k));
    const next = this.steps[following];
    const open = this.#open();
    const {adding} = this.photographs;
    return [
      h('h2', {id: 'title', tabindex: -1}, `${this.step + 1} ${current.title}`),
      h('p.what', {}, current.what()),
      missing.length && !(current.listsMissing && this.project.document.trials.length)
        ? h('div.missing', {}, h('strong', {}, 'Still missing: '), missing.join('; '), '.')
        : null,
      ...current.panel(),
      h(
        'div.onward',
        {},
        this.step ? button('Back', () => this.go(this.skips(this.step - 1) ? 0 : this.step - 1)) : null,
        open
          ? button(
              `Go on: ${current.ready ? `the ${this.placed(...open)}` : `trial ${open[0] + 1}`}`,
              () => this.choose(...open),
              {
                class: 'primary',
              },
            )
          : null,
        adding && next
          ? h('span.note', {}, `Wait until ${counted(adding, 'photograph is', 'photographs are')} added.`)
          : null,
        next
          ? button(`Next: ${next.title}`, () => this.go(following), {
              class: missing.length ? null : 'primary',
              disabled: adding > 0,
            })
          : null,
      ),
    ];
  }

  #filmPanel() {
    const {film} = this;
    const last = this.steps.length - 1;
    return [
      h('h2', {id: 'title', tabindex: -1}, 'Film'),
      h('p.what', {}, film.what()),
      ...film.panel(),
      h(
        'div.onward',
        {},
        button('Back', () => this.go(0)),
        button(`Next: ${this.steps[last].title}`, () => this.go(last), {
          class: film.done() ? 'primary' : null,
        }),
      ),
    ];
  }

  /** @returns {[number, string] | null} the next photograph that this step needs, if the shown one is done */
  #open() {
    const {current} = this;
    const open = current.ready
      ? this.used().filter(([, , id]) => !current.ready(id))
      : this.step && current.open
        ? current.open()
        : [];
    const here = open.some(([k, , id]) => (current.ready ? id === this.id : k === this.trial));
    return open.length && !here ? open[0].slice(0, 2) : null;
  }

  #strip() {
    return this.project.document.trials.map((trial, k) =>
      h(
        'div.trial',
        {key: k, role: 'group', 'aria-label': `Trial ${k + 1}`},
        h('span.caption', {}, `Trial ${k + 1}`),
        Object.keys(ROLES)
          .filter((role) => trial[role] && (this.current.sides || !role.endsWith('side')))
          .map((role) => {
            const chosen = k === this.trial && role === this.role;
            const good = this.current.ready?.(trial[role]);
            return h(
              'button',
              {
                key: role,
                type: 'button',
                'aria-current': chosen ? 'true' : null,
                'aria-label': `${ROLES[role]} of trial ${k + 1}${good === undefined ? '' : good ? ', done' : ', open'}`,
                onclick: () => this.choose(k, role),
              },
              h('img', {src: address(trial[role], 320), alt: '', loading: 'lazy'}),
              h('span', {}, ROLES[role].replace('from the side', 'side'), good ? ' ✓' : ''),
            );
          }),
      ),
    );
  }

  #tools() {
    const {view} = this;
    return [
      button('−', () => view.zoom(0.7), {'aria-label': 'Zoom out', title: 'Zoom out (−)'}),
      button('+', () => view.zoom(1.4), {'aria-label': 'Zoom in', title: 'Zoom in (+)'}),
      button('⤢', () => view.fit(), {'aria-label': 'Show the whole photograph', title: 'Show all of it (0)'}),
    ];
  }

  #keys(event) {
    if (!(event.ctrlKey || event.metaKey) || event.altKey || !this.project.state) return;
    const {target} = event;
    if (target.matches?.('input:not([type=range], [type=checkbox], [type=radio], [type=file])')) return;
    const key = event.key.toLowerCase();
    if (key === 'z') event.shiftKey ? this.project.redo() : this.project.undo();
    else if (key === 'y') this.project.redo();
    else return;
    event.preventDefault();
  }
}

new App().open();
