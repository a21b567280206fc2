// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Hands and their marks in words. */

export const HANDS = ['left_hand', 'right_hand'];

/** @returns {string} a short name, for the photograph */
export const letter = (name) => (name === HANDS[0] ? 'L' : name === HANDS[1] ? 'R' : name.slice(0, 2));

/** @returns {string} a mark for those who do not see it */
export function labelled(one, entry) {
  const several = entry.steps.length > 1 ? ` of movement ${Number(one.name.split(' ')[1]) + 1}` : '';
  if (one.way !== undefined)
    return `Waypoint ${one.way + 1}${several}. Arrow keys move it, Delete removes it.`;
  const name = one.hand.replace('_', ' ');
  return one.name.startsWith('open')
    ? `Where the ${name} opened${several}. Arrow keys move it, Delete puts it back on the DLO.`
    : `Where the ${name} grips${several}: ${(100 * one.fraction).toFixed(1)} % of the length. Arrow keys move it along the DLO.`;
}
