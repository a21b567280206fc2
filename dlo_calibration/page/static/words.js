// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Numbers and lengths as people read them. */

/** @param {number | null} value @returns {string} three significant digits */
export function number(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  if (value === 0) return '0';
  const size = Math.abs(value);
  if (size < 1e-4 || size >= 1e6)
    return value
      .toExponential(2)
      .replace(/\.?0+e/, 'e')
      .replace('e+', 'e');
  const digits = Math.max(0, 2 - Math.floor(Math.log10(size)));
  return String(Number(value.toFixed(Math.min(digits, 12))));
}

/** @param {number | null} metres @param {number} digits @returns {string} in mm */
export function millimetres(metres, digits = 0) {
  return metres === null || metres === undefined ? '–' : `${(1e3 * metres).toFixed(digits)} mm`;
}

/** @param {number} value in SI units @param {string} unit @returns {string} with its unit, lengths in mm */
export function measured(value, unit) {
  if (unit === 'm') return `${number(value === null ? null : 1e3 * value)} mm`;
  return unit === '1' || !unit ? number(value) : `${number(value)} ${spelled(unit)}`;
}

/** @returns {boolean} whether a parameter is one of up to 18 components of a rest shape, as sentences say */
export function isComponent(name) {
  return /^rest_curvature_[xy]\d$/.test(name);
}

/** @returns {string} both ends of an interval with one unit */
export function interval(lower, upper, unit) {
  const [low, high] = unit === 'm' ? [1e3 * lower, 1e3 * upper] : [lower, upper];
  const name = unit === 'm' ? 'mm' : spelled(unit);
  return `${number(low)} to ${number(high)}${name && unit !== '1' ? ` ${name}` : ''}`;
}

function spelled(unit) {
  return (unit ?? '').replace(/\^2/g, '²').replace(/\^3/g, '³');
}

/** @param {number} seconds @returns {string} */
export function duration(seconds) {
  if (seconds < 1.5) return 'a second';
  if (seconds < 90) return `${Math.round(seconds)} s`;
  return `${Math.round(seconds / 60)} minutes`;
}

/** @returns {string} 'one thing', '3 things' */
export function counted(count, one, many = `${one}s`) {
  return `${count} ${count === 1 ? one : many}`;
}

/** @returns {string} a parameter's name in words */
export function words(name) {
  return name.replace(/_/g, ' ');
}
