// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** How to take photographs: three steps for beginners. */

import {h} from './dom.js';
import {boards} from './parts.js';
import {pictures} from './pictures.js';

/** Describe the steps. */
export function introduction() {
  const steps = [
    [
      'sheet',
      [
        'Print the ',
        boards(),
        ' in its full size and lay it flat beside the DLO; it gives the scale. ',
        'No printer? Four points whose places you know will do.',
      ],
    ],
    [
      'camera',
      [
        'Photograph from above, so that the whole DLO and the board are visible. Fix the camera if you can.',
      ],
    ],
    [
      'grasp_and_place',
      [
        'Grip the DLO with one hand, move that point to another place, open the hand. When the DLO lies still, ' +
          'photograph it again.',
      ],
    ],
  ];
  return h(
    'ol.introduction',
    {},
    steps.map(([picture, text]) => h('li', {}, pictures[picture](), h('p', {}, text))),
  );
}
