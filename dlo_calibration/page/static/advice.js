// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The movement to do next: in words, and as an arrow over the newest photograph or film. */

import {h} from './dom.js';
import {line} from './line.js';
import {button, hand} from './parts.js';

/** Describe the arrows over a photograph or film, given by its id: from where a hand grips to where it opens. */
export function arrows(app, id) {
  const {advice} = app.project.state;
  if (!advice || advice.view !== id) return [];
  return advice.ways.flatMap((way, k) => {
    const seen = way.filter((pixel) => pixel.every((value) => value !== null));
    if (seen.length < 2) return [];
    const [[a, b], [u, v]] = seen.slice(-2);
    const turn = (Math.atan2(v - b, u - a) * 180) / Math.PI;
    return [
      line(seen, `advised hand${k}`, `advised ${k}`),
      h(
        'g.head',
        {key: `head ${k}`, class: `hand${k}`, 'data-u': u, 'data-v': v},
        h('path', {transform: `rotate(${turn.toFixed(1)})`, d: 'M4 0L-18-11V11Z'}),
      ),
      hand(`advised hand ${k}`, `hand${k}`, seen[0]),
    ];
  });
}

/** Describe the movement in words, with a button that shows it; null while it is not known. */
export function advised(app, shown = null) {
  const {advice} = app.project.state;
  if (!advice) return null;
  return h(
    'section.advice',
    {key: 'advice', 'aria-label': 'Next movement', role: 'status'},
    h('h3', {}, advice.ways.length ? 'Next movement' : 'No movement helps more'),
    h('p', {}, `${advice.words}.`),
    advice.ways.length && shown !== advice.view
      ? button('Show it on the newest picture', () => show(app, advice.view))
      : null,
  );
}

function show(app, view) {
  const {films, trials} = app.project.document;
  if (films.some((film) => film.id === view)) {
    app.openFilm(view, true);
    return;
  }
  app.go(app.steps.length - 1);
  app.choose(trials.length - 1, 'goal');
}
