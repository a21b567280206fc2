// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Small pictures of the movements of hands, and of how to take photographs. */

import {h} from './dom.js';

const shape = (kind, d) => h(`path.${kind}`, {d});
const hand = (x, y) =>
  h(
    'g.hand',
    {transform: `translate(${x} ${y})`},
    h('path', {d: 'M-5-9V-2Q-5 1-2 1M5-9V-2Q5 1 2 1M-5-9H5M0-9V-14'}),
  );
const table = shape('table', 'M4 43H76');

function picture(name, ...content) {
  return () => h('svg', {class: `picture ${name}`, viewBox: '0 0 80 50', 'aria-hidden': 'true'}, content);
}

/** By name: functions that describe a picture. */
export const pictures = {
  grasp_and_place: picture(
    'grasp',
    table,
    shape('before', 'M8 40H44'),
    shape('dlo', 'M8 40H34Q46 40 54 38'),
    shape('way', 'M44 36Q44 14 54 14T64 34'),
    shape('arrow', 'M60 29L64 35L68 29'),
    hand(56, 36),
  ),
  drag: picture(
    'drag',
    table,
    shape('before', 'M8 40H40'),
    shape('dlo', 'M14 40H62'),
    shape('way', 'M40 31H52'),
    shape('arrow', 'M48 27L53 31L48 35'),
    hand(62, 40),
  ),
  lift_and_hold: picture(
    'lift',
    table,
    shape('dlo', 'M6 41H22Q34 41 40 24Q46 41 58 41H74'),
    shape('way', 'M56 34V12'),
    shape('arrow', 'M52 17L56 11L60 17'),
    hand(40, 24),
  ),
  push_down: picture(
    'push',
    table,
    shape('before', 'M8 22Q40 6 72 22'),
    shape('dlo', 'M8 22Q26 20 40 34Q54 20 72 22'),
    shape('way', 'M58 26V40'),
    shape('arrow', 'M54 35L58 41L62 35'),
    hand(40, 34),
  ),
  two_hands: picture(
    'two',
    table,
    shape('dlo', 'M6 38L24 24Q40 36 56 24L74 38'),
    shape('way', 'M17 8H5M63 8H75'),
    shape('arrow', 'M9 4L4 8L9 12M71 4L76 8L71 12'),
    hand(24, 24),
    hand(56, 24),
  ),
  path: picture(
    'path',
    table,
    shape('before', 'M6 40H30'),
    shape('dlo', 'M6 40H24Q50 42 66 30'),
    shape('way', 'M28 36C24 12 42 6 46 20S60 34 66 24'),
    shape('points', 'M28 36h.1M33 16h.1M46 20h.1'),
    hand(66, 30),
  ),
  release: picture(
    'release',
    table,
    shape('before', 'M8 41Q30 41 40 22Q50 41 72 41'),
    shape('dlo', 'M8 41Q28 41 40 38Q52 41 72 41'),
    h('g.hand', {transform: 'translate(40 20)'}, h('path', {d: 'M-9-9L-11-1M9-9L11-1M-9-9H9M0-9V-14'})),
    shape('arrow', 'M36 26L40 31L44 26'),
  ),
  sheet: picture(
    'sheet',
    shape('paper', 'M46 10L72 14L66 42L40 38Z'),
    shape(
      'squares',
      'M48 14l5 1-1 5-5-1zM57 15l5 1-1 5-5-1zM51 22l5 1-1 5-5-1zM60 24l5 1-1 5-5-1zM46 29l5 1-1 5-5-1zM55 31l5 1-1 5-5-1z',
    ),
    shape('dlo', 'M6 14Q30 8 24 24T34 42'),
  ),
  camera: picture(
    'camera',
    table,
    shape('dlo', 'M14 41Q26 36 40 41T68 41'),
    shape('case', 'M28 4H52V16H28Z'),
    h('circle.case', {cx: 40, cy: 12, r: 5}),
    shape('rays', 'M36 17L14 38M44 17L68 38'),
  ),
};
