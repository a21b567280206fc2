// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The fields for the properties of the DLO. */

import {h} from './dom.js';
import {numeric} from './parts.js';

/** Describe the fields; refusals are shown at `place`. */
export function dloFields(app, place) {
  const {dlo} = app.project.document;
  const know = (change) =>
    app.project.edit(
      (now) => {
        Object.assign(now.dlo, change);
      },
      {place},
    );
  return h(
    'fieldset',
    {key: 'dlo'},
    h('legend', {}, 'What you know of the DLO'),
    numeric({
      label: 'Diameter',
      unit: 'mm',
      factor: 1e3,
      value: dlo.diameter,
      optional: true,
      minimum: 0.0002,
      maximum: 0.2,
      placeholder: 'measured',
      key: 'diameter',
      onset: (value) => know({diameter: value}),
    }),
    numeric({
      label: 'Mass',
      unit: 'g',
      factor: 1e3,
      value: dlo.mass || null,
      optional: true,
      minimum: 0,
      maximum: 1000,
      placeholder: 'unknown',
      key: 'mass',
      onset: (value) => know({mass: value ?? 0}),
    }),
    dlo.mass
      ? null
      : h(
          'p.note',
          {},
          'Without the mass, only the stiffness relative to the weight can be found. Kitchen scales will do.',
        ),
    numeric({
      label: 'Points of a chain',
      value: dlo.points,
      minimum: 5,
      maximum: 200,
      step: 1,
      key: 'points',
      onset: (value) => know({points: value}),
    }),
  );
}
