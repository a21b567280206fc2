// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Step 2, scale: from pixels of a photograph to places on the table. */

import {Clamps, hangs} from './clamps.js';
import {h} from './dom.js';
import {KnownPoints, PLACE} from './known_points.js';
import {line} from './line.js';
import {Obstacles} from './obstacles.js';
import {boards, button, choice, files, legend, numeric, problem} from './parts.js';
import {millimetres} from './words.js';

const RULER = 0.1; // m, nominal length of the board's ruler line
const POOR = 0.003; // m: a larger residual is pointed out

export class ScaleStep {
  title = 'Scale';
  sides = true;
  #points;
  #clamps;
  #obstacles;

  constructor(app) {
    this.app = app;
    this.#points = new KnownPoints(app);
    this.#clamps = new Clamps(app);
    this.#obstacles = new Obstacles(app);
  }

  what() {
    return this.#hanging
      ? 'Give the page a scale: the length of the DLO, or the distance of the clamps.'
      : 'Give the page a scale: the printed board in the photograph, or four points whose places you know.';
  }

  missing() {
    const {app} = this;
    const open = app
      .used()
      .filter(([, , id]) => !this.ready(id))
      .map(([k, role]) => app.placed(k, role));
    return open.length ? [`the scale of ${open.slice(0, 3).join(', ')}${open.length > 3 ? ' …' : ''}`] : [];
  }

  ready(id) {
    const {scale} = this.app.project.photograph(id); // of a DLO that hangs, the line gives it in the next step
    return Boolean(this.app.project.seen(id)?.scale || scale?.length || scale?.gap);
  }

  done() {
    const used = this.app.used();
    return used.length > 0 && used.every(([, , id]) => this.ready(id));
  }

  clicks() {
    return this.#pointed || this.#hanging || this.#obstacles.placing;
  }

  /** Whether the scale of the photograph comes from points that are clicked. */
  get #pointed() {
    return this.app.photograph?.scale?.kind === 'points';
  }

  get #hanging() {
    return hangs(this.app.photograph);
  }

  panel() {
    const {app} = this;
    const {photograph, seen} = app;
    if (!photograph) return [h('p', {}, 'There is no photograph yet: add one in step 1.')];
    if (this.#hanging)
      return [
        h('h3', {}, photograph.name),
        this.#clamps.panel(photograph),
        problem(app.project, PLACE),
        h('div', {role: 'status'}, this.#outcome(seen)),
        this.#lens(),
      ];
    const kind = photograph.scale?.kind ?? 'none';
    const others = app
      .used()
      .filter(([, , id]) => id !== photograph.id && !hangs(app.project.photograph(id)));
    return [
      h('h3', {}, photograph.name),
      h(
        'fieldset.choices',
        {},
        h('legend', {}, 'Where does the scale of this photograph come from?'),
        this.#choice('board', kind, 'The printed board lies in it'),
        this.#choice('points', kind, 'Four or more points whose places I know'),
        others.length
          ? this.#choice('same', kind, 'The camera did not move since another photograph')
          : null,
      ),
      kind === 'board' ? this.#board(photograph) : null,
      kind === 'points' ? this.#points.panel(photograph, seen) : null,
      kind === 'same'
        ? choice({
            label: 'The other photograph',
            value: photograph.scale.photograph,
            key: 'same',
            tall: true,
            choices: others.map(([k, role, id]) => [
              id,
              `${app.project.photograph(id).name} (${app.placed(k, role)})`,
            ]),
            onset: (id) => this.#set({kind: 'same', photograph: id}),
          })
        : null,
      kind !== 'none' && others.length
        ? h(
            'div.row',
            {},
            button(
              kind === 'board'
                ? 'The board lies in all photographs'
                : 'The camera did not move: same scale for all',
              () => this.#forAll(),
            ),
          )
        : null,
      problem(app.project, PLACE),
      h('div', {role: 'status'}, this.#outcome(seen)),
      this.#obstacles.panel(),
      this.#lens(),
    ];
  }

  #choice(value, kind, text) {
    const {app} = this;
    const first = app.used().find(([, , id]) => id !== app.id && !hangs(app.project.photograph(id)))?.[2];
    const scales = {
      board: {kind: 'board', ruler: RULER},
      points: {kind: 'points', points: []},
      same: {kind: 'same', photograph: first},
    };
    return h(
      'label.tick',
      {key: value},
      h('input', {
        type: 'radio',
        name: 'scale',
        value,
        checked: kind === value,
        onchange: () => this.#set(scales[value]),
      }),
      h('span', {}, text),
    );
  }

  #board(photograph) {
    return h(
      'div.group',
      {key: 'board'},
      h(
        'p.note',
        {},
        'Print the ',
        boards(),
        ' in its full size (100 %), and lay it flat on the table.',
      ),
      numeric({
        label: 'Length of its ruler line, as you measure it',
        unit: 'mm',
        factor: 1e3,
        minimum: 0.05,
        maximum: 0.2,
        value: photograph.scale.ruler,
        key: 'ruler',
        onset: (ruler) => this.#set({kind: 'board', ruler}, 'ruler'),
      }),
    );
  }

  #outcome(seen) {
    if (!seen) return null;
    if (seen.scale_problem) return h('p.problem', {}, seen.scale_problem);
    if (!seen.scale) return null;
    const {residual, warnings} = seen.scale;
    return h(
      'div.outcome',
      {class: residual > POOR ? 'weak' : 'good'},
      h(
        'p',
        {},
        h('strong', {}, 'The scale is known. '),
        this.#hanging
          ? 'Check that the grid stands upright in the photograph.'
          : [
              `Its points fit to ${millimetres(residual, 2)}. `,
              residual > POOR
                ? 'That is a large error: check the points.'
                : 'Check that the grid lies flat on the table in the photograph.',
            ],
      ),
      warnings.map((text) => h('p.note', {}, text)),
    );
  }

  #lens() {
    const {project} = this.app;
    const {lens} = project.state;
    return h(
      'details',
      {key: 'lens', open: Boolean(lens)},
      h('summary', {}, 'Lens distortion'),
      h(
        'p.note',
        {},
        lens
          ? `The calibration ${lens} is used for all photographs.`
          : 'Straight lines that look bent need a correction: give the YAML file of a ROS camera calibration.',
      ),
      h(
        'div.row',
        {},
        files({
          text: 'Choose a calibration file …',
          accept: '.yaml,.yml',
          key: 'file',
          onfiles: ([file]) => project.ask('lens', {body: file, name: file.name, place: 'lens'}),
        }),
        lens ? button('Remove it', () => project.ask('lens', {method: 'DELETE', place: 'lens'})) : null,
      ),
      problem(project, 'lens'),
    );
  }

  drawn() {
    const {seen, photograph} = this.app;
    const grid = (seen.scale?.grid ?? []).map(({pixels, label}, k) => {
      const [u, v] = pixels[Math.floor(pixels.length / 2)];
      return h(
        'g',
        {key: `grid${k}`},
        line(pixels, 'grid'),
        h('g.label', {'data-u': u, 'data-v': v}, h('text', {x: 4, y: -4}, label)),
      );
    });
    const points = this.#pointed
      ? this.#points.marks(photograph)
      : this.#hanging
        ? this.#clamps.marks(photograph)
        : [];
    const corners = points.length
      ? []
      : (seen.scale?.pixels ?? []).map(([u, v], k) =>
          h('g.corner', {key: `corner${k}`, 'data-u': u, 'data-v': v}, h('circle', {r: 3})),
        );
    return [...grid, ...corners, ...points, ...this.#obstacles.drawn()];
  }

  tap(pixel) {
    if (this.#obstacles.placing) this.#obstacles.tap(pixel);
    else if (this.#pointed) this.#points.tap(pixel);
    else if (this.#hanging) this.#clamps.tap(pixel);
  }

  grab(name) {
    return this.#of(name).grab(name);
  }

  nudge(name, by) {
    this.#of(name).nudge(name, by);
  }

  press(name, key) {
    return this.#of(name).press(name, key);
  }

  #of(mark) {
    return mark.startsWith('obstacle') ? this.#obstacles : mark.startsWith('clamp') ? this.#clamps : this.#points;
  }

  #set(scale, merge) {
    const {id} = this.app;
    this.app.project.edit(
      (now) => {
        now.photographs.find((photograph) => photograph.id === id).scale = scale;
      },
      {merge, place: PLACE},
    );
  }

  #forAll() {
    const {id, photograph} = this.app;
    const {scale} = photograph;
    const source = scale.kind === 'same' ? scale.photograph : id;
    const sides = new Set(
      this.app
        .used(false)
        .filter(([, role]) => role.endsWith('side'))
        .map(([, , side]) => side),
    );
    this.app.project.edit(
      (now) => {
        for (const other of now.photographs) {
          if (other.id === source || other.id === id || hangs(other)) continue;
          if (scale.kind !== 'board' && sides.has(other.id)) continue;
          other.scale = scale.kind === 'board' ? structuredClone(scale) : {kind: 'same', photograph: source};
        }
      },
      {place: PLACE},
    );
  }

  player() {
    return [
      this.app.seen?.scale
        ? legend(
            [
              ['grid', this.#hanging ? 'grid of the plane in which it hangs' : 'grid of the table'],
              this.#pointed ? ['mark known', 'known point'] : null,
              this.app.seen.obstacles?.length ? ['obstacle', 'top and foot of an obstacle'] : null,
            ].filter(Boolean),
          )
        : null,
    ];
  }
}
