// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Numbers and lengths as people read them. */

/**
 * @param {number | null} value
 * @param {number | null} beside a number next to it: both have the power of ten of the larger one
 * @returns {string} three significant digits, with a power of ten only where very large or very small
 */
export function number(value, beside = null) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  if (value === 0) return '0';
  const largest = Math.max(Math.abs(value), Math.abs(beside ?? 0));
  const exponent = largest >= 1e-3 && largest < 1e6 ? 0 : Number(largest.toExponential(2).split('e')[1]);
  const shown = Number((value / 10 ** exponent).toPrecision(3));
  const digits = Math.min(20, Math.max(0, 2 - Math.floor(Math.log10(Math.abs(shown)))));
  const text = shown.toFixed(digits).replace(/(\.\d*?)0+$/, '$1').replace(/\.$/, '');
  return exponent ? `${text}e${exponent}` : text;
}

/** @param {number | null} metres @param {number} digits @returns {string} in mm */
export function millimetres(metres, digits = 0) {
  return metres === null || metres === undefined ? '–' : `${(1e3 * metres).toFixed(digits)} mm`;
}

/**
 * @param {number} value in SI units
 * @param {string} unit
 * @param {number | null} beside see `number`
 * @returns {string} with its unit, lengths in mm
 */
export function measured(value, unit, beside = null) {
  return withUnit([value], unit, beside);
}

/** @returns {boolean} whether a parameter is one of up to 18 components of a rest shape, as sentences say */
export function isComponent(name) {
  return /^rest_curvature_[xy]\d$/.test(name);
}

/** @returns {string} both ends of an interval with one unit */
export function interval(lower, upper, unit) {
  return withUnit([lower, upper], unit, Math.max(Math.abs(lower), Math.abs(upper)));
}

function withUnit(values, unit, beside) {
  const factor = unit === 'm' ? 1e3 : 1;
  const scaled = (value) => (typeof value === 'number' ? factor * value : null);
  const text = values.map((value) => number(scaled(value), scaled(beside))).join(' to ');
  const name = unit === 'm' ? 'mm' : unit === '1' ? '' : (unit ?? '');
  return name ? `${text} ${name.replace(/\^2/g, '²').replace(/\^3/g, '³')}` : text;
}

/** @param {number} seconds @returns {string} */
export function duration(seconds) {
  if (seconds < 1.5) return 'a second';
  if (seconds < 90) return `${Math.round(seconds)} s`;
  return `${Math.round(seconds / 60)} minutes`;
}

/** @returns {string} 'one thing', '3 things' */
export function counted(count, noun, many = `${noun}s`) {
  return `${count} ${count === 1 ? noun : many}`;
}

/** @returns {string} a parameter's name in words */
export function words(name) {
  return name.replace(/_/g, ' ');
}
