// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Hands and their marks in words. */

export const HANDS = ['left_hand', 'right_hand'];

/** @returns {string} a short name, for the photograph */
export const letter = (name) => (name === HANDS[0] ? 'L' : name === HANDS[1] ? 'R' : name.slice(0, 2));

/** @returns {string} a name in words */
export const spoken = (name) => name.replace('_', ' ');

/** @returns {string} the label of a mark, for screen readers */
export function labelled(mark, entry) {
  const several = entry.steps.length > 1 ? ` of movement ${Number(mark.name.split(' ')[1]) + 1}` : '';
  if (mark.way !== undefined)
    return `Waypoint ${mark.way + 1}${several}. Arrow keys move it, Delete removes it.`;
  const name = spoken(mark.hand);
  return mark.name.startsWith('open')
    ? `Where the ${name} opened${several}. Arrow keys move it, Delete puts it back on the DLO.`
    : `Where the ${name} grips${several}: ${(100 * mark.fraction).toFixed(1)} % of the length. Arrow keys move it along the DLO.`;
}
