// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Geometry in the plane of a photograph, and between it and the table. */

/** @typedef {[number, number]} Point */

export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
const mixed = (a, b, t) => [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];

/**
 * Find where a polyline comes nearest to a point.
 *
 * @param {Point[]} line
 * @param {Point} point
 * @returns {{at: number, point: Point, distance: number}} `at`: number of the piece plus the share of it
 */
export function nearest(line, point) {
  let best = {at: 0, point: line[0], distance: distance(line[0], point)};
  for (let i = 0; i + 1 < line.length; i++) {
    const [a, b] = [line[i], line[i + 1]];
    const [x, y] = [b[0] - a[0], b[1] - a[1]];
    const square = x * x + y * y;
    const share = square ? ((point[0] - a[0]) * x + (point[1] - a[1]) * y) / square : 0;
    const t = Math.min(1, Math.max(0, share));
    const candidate = mixed(a, b, t);
    const off = distance(candidate, point);
    if (off < best.distance) best = {at: i + t, point: candidate, distance: off};
  }
  return best;
}

/** @returns {Point} the point of a polyline at a number of the piece plus a share of it */
export function along(line, at) {
  const place = Math.min(line.length - 1, Math.max(0, at));
  const i = Math.min(line.length - 2, Math.floor(place));
  return line.length < 2 ? line[0] : mixed(line[i], line[i + 1], place - i);
}

/** @returns {Point} interpolated in time between points that belong to times */
export function during(times, points, time) {
  let k = 0;
  while (k + 2 < times.length && times[k + 1] < time) k++;
  if (times.length < 2) return points[0];
  const span = times[k + 1] - times[k];
  const t = span > 0 ? Math.min(1, Math.max(0, (time - times[k]) / span)) : 1;
  return mixed(points[k], points[k + 1], t);
}

/**
 * Assign each click the place on the line where it belongs, in order: the places never go back.
 *
 * @param {Point[]} line
 * @param {Point[]} clicks
 * @returns {number[]} indices of the line
 */
export function placesOf(line, clicks) {
  const best = clicks.map(() => new Float64Array(line.length));
  const from = clicks.map(() => new Int32Array(line.length));
  clicks.forEach((click, k) => {
    let least = 0;
    line.forEach((point, i) => {
      const cost = distance(point, click) ** 2;
      if (k && best[k - 1][i] < best[k - 1][least]) least = i;
      best[k][i] = cost + (k ? best[k - 1][least] : 0);
      from[k][i] = least;
    });
  });
  const places = new Array(clicks.length);
  let at = best[clicks.length - 1].reduce((low, cost, i, all) => (cost < all[low] ? i : low), 0);
  for (let k = clicks.length - 1; k >= 0; k--) {
    places[k] = at;
    at = from[k][at];
  }
  return places;
}

/**
 * Find the two passages of a line through a crossing.
 *
 * @returns {[number, number]} indices of the line, the earlier passage first
 */
export function passages(line, crossing, width) {
  const offs = line.map((point) => distance(point, crossing));
  const least = (allowed) =>
    offs.reduce((low, off, i) => (allowed(i) && (low < 0 || off < offs[low]) ? i : low), -1);
  const first = least(() => true);
  const ends = [];
  for (const direction of [-1, 1]) {
    // leave the first passage before looking for the second one
    let i = first;
    while (i >= 0 && i < line.length && offs[i] < 2 * width) i += direction;
    ends.push(i);
  }
  const second = least((i) => i <= ends[0] || i >= ends[1]);
  return second < 0 ? [first, first] : [Math.min(first, second), Math.max(first, second)];
}

/**
 * Find the homography that maps points to others, by least squares (four points or more).
 *
 * @param {Point[]} from
 * @param {Point[]} to
 * @returns {((point: Point) => Point) | null} the map; null where the points do not determine it
 */
function homography(from, to) {
  if (from.length < 4) return null;
  const [a, b] = [normalised(from), normalised(to)];
  const normal = Array.from({length: 8}, () => new Array(9).fill(0));
  a.points.forEach(([x, y], k) => {
    const [u, v] = b.points[k];
    for (const row of [
      [x, y, 1, 0, 0, 0, -u * x, -u * y, u],
      [0, 0, 0, x, y, 1, -v * x, -v * y, v],
    ]) {
      for (let i = 0; i < 8; i++) for (let j = 0; j < 9; j++) normal[i][j] += row[i] * row[j];
    }
  });
  const m = solved(normal);
  if (!m) return null;
  return ([x, y]) => {
    const [p, q] = [(x - a.centre[0]) / a.size, (y - a.centre[1]) / a.size];
    const w = m[6] * p + m[7] * q + 1;
    return [
      ((m[0] * p + m[1] * q + m[2]) / w) * b.size + b.centre[0],
      ((m[3] * p + m[4] * q + m[5]) / w) * b.size + b.centre[1],
    ];
  };
}

function normalised(points) {
  const centre = [0, 1].map((k) => points.reduce((sum, point) => sum + point[k], 0) / points.length);
  const size = Math.max(1e-12, ...points.map((point) => distance(point, centre)));
  return {
    centre,
    size,
    points: points.map((point) => [(point[0] - centre[0]) / size, (point[1] - centre[1]) / size]),
  };
}

/** Solve linear equations, the right side in the last column, by elimination; null where they are singular. */
function solved(rows) {
  const count = rows.length;
  for (let i = 0; i < count; i++) {
    let pivot = i;
    for (let k = i; k < count; k++) if (Math.abs(rows[k][i]) > Math.abs(rows[pivot][i])) pivot = k;
    if (Math.abs(rows[pivot][i]) < 1e-12) return null;
    [rows[i], rows[pivot]] = [rows[pivot], rows[i]];
    for (let k = 0; k < count; k++) {
      if (k === i) continue;
      const share = rows[k][i] / rows[i][i];
      for (let j = i; j <= count; j++) rows[k][j] -= share * rows[i][j];
    }
  }
  return rows.map((row, i) => row[count] / row[i]);
}

const STEPS = 5; // until the pixel of a place is exact to far below a pixel

/**
 * Map between pixels of a photograph and places on the table, the distortion of the lens included.
 *
 * Between the lattice's points, the difference to the homography is interpolated.
 *
 * @param {{columns: number[], rows: number[], table: Point[][]}} lattice where on the table the pixels are
 * @returns {{table: (pixel: Point) => Point, pixel: (place: Point) => Point} | null} null: nothing of the table is seen
 */
export function tableMap({columns, rows, table}) {
  if (rows.length < 2) return null;
  const pixels = rows.flatMap((v) => columns.map((u) => [u, v]));
  const [there, back] = [homography(pixels, table.flat()), homography(table.flat(), pixels)];
  if (!there || !back) return null;
  const lacks = rows.map((v, j) =>
    columns.map((u, i) => {
      const [x, y] = there([u, v]);
      return [table[j][i][0] - x, table[j][i][1] - y];
    }),
  );
  const place = ([u, v]) => {
    const [i, s] = cell(columns, u);
    const [j, t] = cell(rows, v);
    const [x, y] = there([u, v]);
    const above = mixed(lacks[j][i], lacks[j][i + 1], s);
    const below = mixed(lacks[j + 1][i], lacks[j + 1][i + 1], s);
    const [a, b] = mixed(above, below, t);
    return [x + a, y + b];
  };
  return {
    table: place,
    pixel: (wanted) => {
      const [u, v] = back(wanted);
      const pixel = [u, v];
      for (let k = 0; k < STEPS; k++) {
        const [p, q] = back(place(pixel));
        pixel[0] += u - p;
        pixel[1] += v - q;
      }
      return pixel;
    },
  };
}

/** @returns {[number, number]} the piece between sorted values where another lies, and the share of it, 0 to 1 */
function cell(values, value) {
  let k = 0;
  while (k + 2 < values.length && values[k + 1] <= value) k++;
  const share = (value - values[k]) / (values[k + 1] - values[k]);
  return [k, Math.min(1, Math.max(0, share))];
}
