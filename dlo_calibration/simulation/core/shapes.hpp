// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Signed distances from the bodies of a scene: of points, and of places between two points.

namespace dlo {
namespace DLO_TARGET {

/// The signed distance [m] of a point from the surface of a body, and its gradient.
struct Field {
  double distance;
  Point gradient;
};

/// The vector with length 1; that of `otherwise` if it has no direction.
inline Field of_length(const Point& away, double less, const Point& otherwise) {
  const double length = sqrt(dot(away, away));
  if (!(length > kTiny)) return {length - less, otherwise};
  return {length - less, {away.x / length, away.y / length, away.z / length}};
}

inline double sign_of(double x) { return x < 0.0 ? -1.0 : 1.0; }

inline Field box_field(const Point& p, const Point& half) {
  const Point beyond = {abs(p.x) - half.x, abs(p.y) - half.y, abs(p.z) - half.z};
  if (beyond.x <= 0.0 && beyond.y <= 0.0 && beyond.z <= 0.0) {  // inside: out of the nearest face
    if (beyond.x >= beyond.y && beyond.x >= beyond.z) return {beyond.x, {sign_of(p.x), 0.0, 0.0}};
    if (beyond.y >= beyond.z) return {beyond.y, {0.0, sign_of(p.y), 0.0}};
    return {beyond.z, {0.0, 0.0, sign_of(p.z)}};
  }
  const auto outside = [](double b, double x) { return b > 0.0 ? b * sign_of(x) : 0.0; };
  return of_length({outside(beyond.x, p.x), outside(beyond.y, p.y), outside(beyond.z, p.z)}, 0.0,
                   {0.0, 0.0, 1.0});
}

/// A cylinder is a box in the plane of its axis and the point.
inline Field cylinder_field(const Point& p, double half, double radius) {
  const double out = sqrt(p.x * p.x + p.y * p.y);
  const Point radial = out > kTiny ? Point{p.x / out, p.y / out, 0.0} : Point{1.0, 0.0, 0.0};
  const Field flat = box_field({out, 0.0, p.z}, {radius, HUGE_VAL, half});
  const Point gradient = flat.gradient.x * radial;
  return {flat.distance, {gradient.x, gradient.y, flat.gradient.z}};
}

/// Trilinear between the points of the grid.  Beyond them, the larger of two lower bounds: the surface lies
/// behind the nearest point of the grid, and the distance grows at least as it does there if it is convex.
inline Field grid_field(const Grid& grid, const Point& p) {
  const double cell = grid.cell;
  const double at[3] = {(p.x - grid.corner.x) / cell, (p.y - grid.corner.y) / cell,
                        (p.z - grid.corner.z) / cell};
  int low[3];
  double share[3], away[3];
  for (int c = 0; c < 3; ++c) {
    const double inside = min(max(at[c], 0.0), grid.counts[c] - 1.0);
    low[c] = static_cast<int>(min(inside, grid.counts[c] - 2.0));
    share[c] = inside - low[c], away[c] = cell * (at[c] - inside);
  }
  const int step_y = grid.counts[2], step_x = grid.counts[1] * step_y;
  const float* first = &grid.distances[low[0] * step_x + low[1] * step_y + low[2]];
  const auto [x, y, z] = share;
  const float *low_y = first + step_x, *high_y = low_y + step_y;  // where x is high
  const auto between = [](double from, double to, double at) { return from + at * (to - from); };
  const double a = between(first[0], first[1], z), b = between(first[step_y], first[step_y + 1], z),
               c = between(low_y[0], low_y[1], z), d = between(high_y[0], high_y[1], z);
  const double ab = between(a, b, y), cd = between(c, d, y), value = between(ab, cd, x);
  const double slope[3] = {
      cd - ab, between(b - a, d - c, x),
      between(between(first[1] - first[0], first[step_y + 1] - first[step_y], y),
              between(low_y[1] - low_y[0], high_y[1] - high_y[0], y), x)};
  const Field inside = of_length({slope[0], slope[1], slope[2]}, 0.0, {0.0, 0.0, 1.0});
  const Point beyond = {away[0], away[1], away[2]};
  const double further = dot(beyond, beyond);
  if (further == 0.0) return {value, inside.gradient};
  const double there = max(value, 0.0);
  return {max(sqrt(further + there * there), there + dot(inside.gradient, beyond)), inside.gradient};
}

inline Field field_of(const Body& body, const Point& at) {
  const Matrix& m = body.turn;
  const Point q = at - body.position;
  const Point p = {m[0] * q.x + m[3] * q.y + m[6] * q.z, m[1] * q.x + m[4] * q.y + m[7] * q.z,
                   m[2] * q.x + m[5] * q.y + m[8] * q.z};
  const auto& sizes = body.sizes;
  Field field;
  switch (body.shape) {
    case Shape::kSphere: field = of_length(p, sizes[0], {0.0, 0.0, 1.0}); break;
    case Shape::kBox: field = box_field(p, {sizes[0], sizes[1], sizes[2]}); break;
    case Shape::kCylinder: field = cylinder_field(p, sizes[0], sizes[1]); break;
    case Shape::kCapsule:
      field = of_length({p.x, p.y, p.z - min(max(p.z, -sizes[0]), sizes[0])}, sizes[1], {1.0, 0.0, 0.0});
      break;
    default: field = grid_field(*body.grid, p);
  }
  return {field.distance, m * field.gradient};
}

/// A place between two points that is nearer to a body than both; `share` is negative if there is none, or if it
/// is further away than asked for: then the distance is a lower bound.
struct Between {
  double share;
  Field field;
};

/// The distance from a convex body has at most one minimum along a segment: where its slope is 0, found by
/// the method of false position (the Illinois variant).
inline Between nearest_between(const Body& body, const Point& a, const Point& b, const Field& at_a,
                               const Field& at_b, double furthest) {
  const Point along = b - a;
  double low = 0.0, high = 1.0, down = dot(at_a.gradient, along), up = dot(at_b.gradient, along);
  if (!(down < 0.0 && up > 0.0)) return {-1.0, {HUGE_VAL, {}}};
  const double crossing = at_a.distance + down * (at_b.distance - up - at_a.distance) / (down - up);
  if (crossing > furthest) return {-1.0, {crossing, {}}};  // of the tangents
  // A grid is exact to a fraction of its cells; an angle of 1e-4 changes its distances by nanometres.
  const double flat = (body.shape == Shape::kGrid ? 1e-4 : 1e-6) * sqrt(dot(along, along));
  int side = 0;
  Between best{};
  for (int k = 0; k < 20; ++k) {
    best.share = low - down * (high - low) / (up - down);
    best.field = field_of(body, a + best.share * along);
    const double slope = dot(best.field.gradient, along);
    if (abs(slope) < flat || high - low < 1e-5) break;
    if (slope > 0.0) {
      high = best.share, up = slope;
      if (side > 0) down /= 2;
      side = 1;
    } else {
      low = best.share, down = slope;
      if (side < 0) up /= 2;
      side = -1;
    }
  }
  return best;
}

}  // namespace DLO_TARGET
}  // namespace dlo
