// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Step 5: the information of the trials, the calibration, its result, and the film. */

import {advised, arrows} from './advice.js';
import {h} from './dom.js';
import {Animation} from './animation.js';
import {button, files, numeric, problem, warnings} from './parts.js';
import {resultPanel} from './result.js';
import {counted, duration, isComponent, number, words} from './words.js';

const PLACE = 'calibration';
const MUCH = 0.4; // share of the standard deviation that remains: below, the trial shows much of a parameter
const SOME = 0.8;
const VERDICTS = {agrees: 'good', changed: 'bad'};

export class CalibrationStep {
  title = 'Calibrate';
  role = 'goal';
  listsMissing = true; // of each trial, below
  evaluations = null;
  namespace = '/calibrator';
  sent = null; // what the node answered
  checked = null; // whether the trials show the DLO of an earlier result
  #announced = 0;
  #before = null;

  constructor(app) {
    this.app = app;
    this.animation = new Animation(app);
    app.project.addEventListener('change', () => this.#announce());
  }

  what() {
    return 'The package tries parameters of a simulated DLO until it moves like yours. Start it when every trial is complete.';
  }

  missing() {
    const {trials} = this.app.project.state;
    if (!trials.length) return ['a trial'];
    return trials.some((trial) => trial.complete) ? [] : ['a complete trial'];
  }

  done() {
    const {result} = this.app.project.state.calibration;
    return Boolean(result && !result.outdated);
  }

  panel() {
    const {app} = this;
    const {state, document: edited} = app.project;
    const {calibration} = state;
    const busy = calibration.state === 'calibrating';
    const trials = h(
      'section',
      {key: 'trials', 'aria-label': 'Trials'},
      state.trials.map((trial, k) => this.#trial(trial, k)),
      edited.films.map((film) =>
        button(`Watch ${film.name}`, () => app.openFilm(film.id), {key: film.id}),
      ),
    );
    const start = h(
      'div.group',
      {key: 'act'},
      busy ? this.#progress(calibration) : this.#start(calibration),
      problem(app.project, PLACE),
      calibration.state === 'failed' && calibration.text
        ? h('p.problem', {role: 'alert'}, calibration.text)
        : null,
    );
    const check = busy ? null : this.#check();
    return calibration.result && !busy
      ? [resultPanel(this, calibration), advised(app, app.id), start, check, trials]
      : [busy ? null : advised(app, app.id), trials, start, check];
  }

  #check() {
    const {app} = this;
    return h(
      'details',
      {key: 'check'},
      h('summary', {}, 'Still the same DLO?'),
      h('p.note', {}, 'Compare these trials with an earlier result of the DLO, a result.xml.'),
      files({
        text: 'Choose a result …',
        accept: '.xml',
        key: 'file',
        onfiles: async ([file]) => {
          this.checked = {verdict: 'comparing', words: ['This takes some seconds …']};
          app.refresh();
          this.checked = await app.project.ask('check', {body: file, name: file.name, place: 'check'});
          app.refresh();
        },
      }),
      this.checked
        ? h(
            'div',
            {role: 'status'},
            h('strong.verdict', {class: VERDICTS[this.checked.verdict] ?? 'weak'}, this.checked.verdict),
            this.checked.words.map((text) => h('p', {}, text)),
          )
        : null,
      problem(app.project, 'check'),
    );
  }

  #trial(trial, k) {
    if (!trial) return null;
    const {app} = this;
    const {information} = trial;
    return h(
      'div.trialcard',
      {key: k, class: k === app.trial ? 'current' : null},
      h(
        'h3',
        {},
        `Trial ${k + 1}${trial.name ? `, ${trial.name}` : ''} `,
        h(
          'span.verdict',
          {class: trial.complete ? 'good' : 'weak'},
          trial.complete ? 'complete' : 'not complete',
        ),
      ),
      information
        ? h('p', {}, information.sentence)
        : trial.complete
          ? h('p.note', {}, 'The information of this trial is being computed …')
          : null,
      information?.parameters
        ? h(
            'ul.shows',
            {'aria-label': `What trial ${k + 1} shows`},
            Object.entries(information.parameters).map(([name, deviation]) =>
              shows(name, deviation.after / deviation.before),
            ),
          )
        : null,
      this.#stillMissing(trial.warnings),
      this.#warnings(k),
    );
  }

  #stillMissing(listed) {
    const errors = listed.filter(({level}) => level === 'error');
    const remedies = errors.map(({remedy}) => this.app.remedies[remedy]).filter(Boolean);
    const places = new Map(remedies.map(({text, act}) => [text, act]));
    return errors.length
      ? h(
          'div.missing',
          {},
          h('strong', {}, 'Still missing:'),
          h(
            'ul',
            {},
            errors.map(({text}) => h('li', {}, text)),
          ),
          h(
            'div.row',
            {},
            [...places].map(([text, act]) => button(text, act)),
          ),
        )
      : null;
  }

  #warnings(k) {
    const listed = this.app.project.state.trials[k].warnings.filter(({level}) => level !== 'error');
    if (k === this.app.trial) return warnings(this.app);
    return listed.length
      ? button(`${counted(listed.length, 'warning')}: show`, () => this.app.choose(k, 'goal'))
      : null;
  }

  #start(calibration) {
    const {result} = calibration;
    const ready = !this.missing().length;
    return h(
      'div.group',
      {key: 'start'},
      result?.outdated ? h('p.problem', {}, 'The trials changed since this result: calibrate again.') : null,
      h(
        'div.row',
        {},
        button(result ? 'Calibrate again' : 'Calibrate', () => this.#calibrate(), {
          class: result && !result.outdated ? null : 'primary',
          disabled: !ready,
        }),
      ),
      h(
        'details',
        {},
        h('summary', {}, 'Options'),
        numeric({
          label: 'Parameter sets to try at most',
          value: this.evaluations,
          optional: true,
          minimum: 1,
          maximum: 100000,
          step: 1,
          placeholder: 'the usual number',
          key: 'evaluations',
          onset: (value) => {
            this.evaluations = value;
          },
        }),
      ),
    );
  }

  async #calibrate() {
    this.sent = null;
    this.app.player.stop();
    await this.app.project.ask('calibrate', {
      body: this.evaluations ? {evaluations: this.evaluations} : {},
      place: PLACE,
    });
  }

  #progress({evaluations, of, seconds_left: left, best}) {
    const rest =
      of && evaluations >= of
        ? '; the result is being examined'
        : left === null
          ? ''
          : `, about ${duration(left)} left`;
    const text = `${evaluations} of ${of || '…'} parameter sets tried${rest}`;
    return h(
      'div.group',
      {key: 'progress'},
      h('progress', {max: of || 1, value: String(evaluations), 'aria-label': 'Progress of the calibration'}),
      h('p', {}, text),
      best
        ? h(
            'p.note',
            {},
            `Best so far: difference ${number(best.score)}; `,
            Object.entries(best.parameters)
              .filter(([name]) => !isComponent(name))
              .map(([name, value]) => `${words(name)} ${number(value)}`)
              .join(', '),
            ' (0 to 100)',
          )
        : null,
      button('Stop, and keep the best', () => this.app.project.ask('stop', {place: PLACE})),
    );
  }

  /** Announce each quarter of the calibration, and its end, to screen readers. */
  #announce() {
    const {state} = this.app.project;
    if (!state) return;
    const {state: now, evaluations, of, seconds_left: left} = state.calibration;
    const quarter = now === 'calibrating' && of ? Math.floor((4 * evaluations) / of) : 0;
    if (now === 'calibrating' && quarter > this.#announced) {
      this.app.say(`${25 * quarter} percent${left === null ? '' : `, about ${duration(left)} left`}`);
    }
    if (this.#before === 'calibrating' && now !== 'calibrating') {
      this.app.say(
        {
          done: 'The calibration is done',
          stopped: 'The calibration was stopped',
          failed: 'The calibration failed',
        }[now] ?? '',
      );
      if (state.calibration.result && this.app.current === this) {
        if (this.app.entry?.goal) this.app.role = 'goal';
        requestAnimationFrame(() => {
          document.getElementById('panel').scrollTop = 0;
        });
      }
    }
    this.#announced = quarter;
    this.#before = now;
  }

  drawn() {
    const {app} = this;
    return [...this.animation.drawn(), ...(app.player.playing ? [] : arrows(app, app.id))];
  }

  player() {
    return this.animation.player();
  }
}

function shows(name, share) {
  const [kind, text] =
    share < MUCH ? ['good', 'much'] : share < SOME ? ['weak', 'some'] : ['bad', 'nearly nothing'];
  return h(
    'li',
    {key: name},
    h('span', {}, words(name)),
    h('meter', {
      min: 0,
      max: 1,
      value: String(Math.max(0, 1 - share)),
      'aria-label': `What is shown of ${words(name)}`,
    }),
    h('span.verdict', {class: kind}, text),
  );
}
