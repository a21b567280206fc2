// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

#include "rope.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#define DLO_TARGET baseline
#include "step.hpp"

namespace dlo {

using namespace baseline;

namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr int kPieces = 64;  // into which a DLO of smoothly varying stiffness is divided

/// The k-th of the places that divide a length into `count` equal parts.
double evenly(double length, int k, int count) { return k == count ? length : k * (length / count); }

/// The value at `place`, linear between `values` at `places`.
double between(double place, const std::vector<double>& places, const std::vector<double>& values) {
  if (!(place < places.back())) return values.back();  // also for nan
  const auto k = std::upper_bound(places.begin() + 1, places.end(), place) - places.begin();
  const double slope = (values[k] - values[k - 1]) / (places[k] - places[k - 1]);
  return slope * (place - places[k - 1]) + values[k - 1];
}

/// The value at a share of a length, linear between `values` at evenly spaced places.
double evenly_between(double share, const std::vector<double>& values) {
  std::vector<double> places;
  const int last = static_cast<int>(values.size()) - 1;
  for (int k = 0; k <= last; ++k) places.push_back(evenly(1.0, k, last));
  return between(share, places, values);
}

}  // namespace

Rope::Rope(const Start& start, const Properties& properties, double step, Point gravity, double level,
           std::shared_ptr<const Scene> scene)
    : properties_(properties) {
  const int n = static_cast<int>(start.points.size()), segments = n - 1;
  rods.nodes = n, rods.step = step, rods.gravity = gravity, rods.level = level;
  rods.friction = properties.friction, rods.drag = properties.drag;
  rods.implicit = step * std::max(properties.internal_damping, 0.6 * step);
  rods.surplus = rods.implicit - step * std::max(properties.internal_damping, 0.2 * step);
  rods.strands_rub = properties.bending_friction > 0.0, rods.locks = properties.locking > 0.0;
  rods.resize();
  rods.points = start.points, rods.velocities = start.velocities, rods.solved = 1.0;
  for (int i = 0; i < segments; ++i) {
    rods.rest_lengths[i] = properties.length_scale * (start.places[i + 1] - start.places[i]);
    rods.stiffness[i] = properties.stretching_stiffness / rods.rest_lengths[i];
    rods.masses[i] += rods.rest_lengths[i] / 2, rods.masses[i + 1] += rods.rest_lengths[i] / 2;
    length_ += rods.rest_lengths[i];
  }
  double total = 0.0;
  for (double mass : rods.masses) total += mass;
  for (int i = 0; i < n; ++i) {
    rods.masses[i] = properties.mass * rods.masses[i] / total;
    if (!start.features.empty()) rods.masses[i] += properties.marker_mass * start.features[i];
  }

  contact.diameter = 2 * properties.radius, contact.friction = properties.friction;
  contact.change.resize(n);
  double end = 0.0;
  for (double length : rods.rest_lengths) {
    end += length;
    contact.half.push_back(length / 2), contact.middles.push_back(end - length / 2);
  }
  const auto &half = contact.half, &middles = contact.middles;
  contact.least_arc = std::max(kTwoPi / 2 * properties.radius, *std::max_element(half.begin(), half.end()));
  for (contact.next_segment = 0; contact.next_segment < segments; ++contact.next_segment) {
    bool may_touch = false;
    for (int i = 0, j = contact.next_segment; j < segments; ++i, ++j)
      may_touch = may_touch || (middles[j] - half[j]) - (middles[i] + half[i]) > contact.least_arc;
    if (may_touch) break;
  }
  for (Spheres* spheres : {&contact.single, &contact.twin})
    for (auto* row : {&spheres->x, &spheres->y, &spheres->z, &spheres->radius}) row->resize(segments);
  begin(contact, rods.points.data());
  if (scene && !scene->bodies.empty()) {
    surroundings.scene = std::move(scene);
    surroundings.radius = properties.radius, surroundings.friction = properties.friction;
    begin(surroundings, rods.points.data(), n);
  }

  if (!start.directions.empty() && !properties.rest_curvature.empty()) {
    directions_ = start.directions;
    for (int i = 0; i < segments; ++i) {
      if (start.places[i] + start.places[i + 1] <= start.places.back()) continue;
      const Point segment = start.points[i + 1] - start.points[i], across = directions_[i];
      const Point axis = 1 / std::sqrt(dot(segment, segment)) * segment;
      const Rotation by = rotation(properties.clamp_twist);
      directions_[i] = by.cosine * across + by.sine * cross(axis, across);
    }
  }
  held = {-1};  // unlike any nodes, so that `hold` does its work
  hold({});
}

void Rope::hold(const std::vector<int>& nodes) {
  if (nodes == held) return;
  const int n = rods.nodes;
  held = nodes;
  targets.assign(held.size(), {}), hand_velocities.assign(held.size(), {}), turns.clear();
  hand_forces.assign(held.size(), {});
  std::vector<bool> follows(n, false), rigid(n - 1);
  inverse_masses.resize(n);
  for (int i = 0; i < n; ++i) inverse_masses[i] = 1 / rods.masses[i];
  for (int node : held) follows[node] = true, inverse_masses[node] = 0.0;
  for (int i = 0; i + 1 < n; ++i) rigid[i] = follows[i] && follows[i + 1];

  // At each inner node: the length that bends, and its stiffness relative to that of the first part.
  const auto& lengths = rods.rest_lengths;
  const std::vector<double> relative = stiffnesses(rigid);
  std::vector<double> cells(n - 2), weights(n - 2);
  std::vector<std::array<double, 3>> bends(n - 2);  // [1/m]; the product with three nodes is the bend
  for (int i = 0; i < n - 2; ++i) {
    cells[i] = ((rigid[i] ? 0.0 : lengths[i]) + (rigid[i + 1] ? 0.0 : lengths[i + 1])) / 2;
    weights[i] = cells[i] > 0 ? relative[i] * (1 / cells[i]) : 0.0;
    const double before = 1 / lengths[i], after = 1 / lengths[i + 1];
    bends[i] = {before, -(before + after), after};
  }
  std::fill(rods.bending.begin(), rods.bending.end(), Bending<double>{});
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b <= a; ++b)
      for (int i = 0; i < n - 2; ++i)
        rods.bending[i + b][a - b] += weights[i] * bends[i][a] * bends[i][b];
  for (auto& row : rods.bending)
    for (double& entry : row) entry *= properties_.bending_stiffness;
  hold_frame(rigid, relative, cells);
  for (std::size_t i = 0; i < rods.strands.size(); ++i) {
    const double slip = properties_.bending_slip, stiffness = properties_.bending_stiffness * weights[i];
    rods.strands[i] = {bends[i], stiffness * (properties_.bending_friction / slip), cells[i] * slip};
  }
  for (std::size_t i = 0; i < rods.locking.size(); ++i) {
    const double radius = cells[i] > 0 ? properties_.locking / cells[i] : 0.0;
    rods.locking[i] = {properties_.bending_stiffness * weights[i], radius * radius};
  }
}

void Rope::hold_frame(const std::vector<bool>& rigid, const std::vector<double>& relative,
                      const std::vector<double>& cells) {
  const int segments = rods.nodes - 1;
  const auto& knots = properties_.rest_curvature;
  const bool curved = properties_.natural_curvature != 0.0 ||
                      std::any_of(knots.begin(), knots.end(), [](auto& k) { return k[0] || k[1]; });
  const std::vector<Clamp> former = std::move(clamps);
  clamps.clear();
  rods.twists = properties_.torsion > 0.0;
  for (int i = 0; rods.twists && i < segments; ++i) {
    if (!rigid[i]) continue;
    const int place = static_cast<int>(std::find(held.begin(), held.end(), i) - held.begin());
    const auto before = std::find_if(former.begin(), former.end(), [&](auto& k) { return k.segment == i; });
    Clamp clamp{i, place, {kNan, kNan, kNan}, {kNan, kNan, kNan}};
    if (before != former.end()) clamp.direction = before->direction, clamp.tangent = before->tangent;
    else if (!frame_begun && !directions_.empty()) clamp.direction = directions_[i];
    clamps.push_back(clamp);
  }
  const bool all_rigid = std::find(rigid.begin(), rigid.end(), false) == rigid.end();
  const bool was_framed = rods.framed;
  rods.framed = (curved || rods.locks || !clamps.empty()) && !all_rigid;
  if (was_framed && frame_begun && !rods.framed && rods.strands_rub && rods.twists) {
    rods.framed = true;  // its arrays still have the sizes
    leave_frame(rods);
    rods.framed = false;
  }
  if (!rods.framed) frame_begun = false, clamps.clear();
  if (rods.framed != was_framed) rods.resize();
  if (!rods.framed) return;
  double place = 0.0;
  for (int i = 0; i + 1 < segments; ++i) {
    place += rods.rest_lengths[i];
    double x = properties_.natural_curvature, y = 0.0;
    if (knots.size() > 1) {
      std::vector<double> values[2];
      for (const auto& knot : knots)
        for (int c : {0, 1}) values[c].push_back(knot[c]);
      x += evenly_between(place / length_, values[0]), y += evenly_between(place / length_, values[1]);
    }
    const int half = place > length_ / 2;
    if (rods.twists && rigid[i + half] > rigid[i + 1 - half]) {  // it leaves a clamp here, towards the middle
      const auto& bend = properties_.clamp_bends[half];
      x += bend[0] / cells[i], y += bend[1] / cells[i];
    }
    const double stiffness = properties_.bending_stiffness * relative[i];
    const double bending = cells[i] > 0 ? stiffness : 0.0;
    const double natural_x = bending * x, natural_y = bending * y;
    rods.natural[i] = {natural_x, natural_y, sqrt(natural_x * natural_x + natural_y * natural_y)};
    // Inside a clamp nothing twists, so that any stiffness will do.
    rods.twisting[i] = rods.twists ? properties_.torsion * stiffness /
                                         (cells[i] > 0 ? cells[i] : rods.rest_lengths[i + 1]) : 0.0;
  }
}

std::vector<double> Rope::stiffnesses(const std::vector<bool>& rigid) const {
  const auto &stiffness_knots = properties_.stiffness_knots, &lengths = rods.rest_lengths;
  std::vector<double> profile = properties_.profile;
  if (stiffness_knots.size() > 1) {
    const std::size_t parts = profile.size();
    profile.resize(kPieces);
    for (int k = kPieces; k-- > 0;)
      profile[k] = properties_.profile[k * parts / kPieces] * evenly_between((k + 0.5) / kPieces, stiffness_knots);
  }
  const int parts = static_cast<int>(profile.size()), inner = rods.nodes - 2;
  std::vector<double> result(inner, 1.0);
  if (std::all_of(profile.begin(), profile.end(), [](double part) { return part == 1.0; })) return result;
  std::vector<double> bounds = {0.0}, flexibility = {0.0};  // the latter up to each bound
  for (int k = 0; k < parts; ++k) {
    bounds.push_back(evenly(length_, k + 1, parts));
    flexibility.push_back(flexibility.back() + (bounds[k + 1] - bounds[k]) / profile[k]);
  }
  double start = 0.0;
  for (int i = 0; i < inner; start += lengths[i++]) {  // the pieces on both sides of a node are in series
    const double a = start + lengths[i] / 2, b = start + lengths[i], c = b + lengths[i + 1] / 2;
    const auto at = [&](double place) { return between(place, bounds, flexibility); };
    const double total = (rigid[i] ? 0.0 : at(b) - at(a)) + (rigid[i + 1] ? 0.0 : at(c) - at(b));
    const double cell = (rigid[i] ? 0.0 : lengths[i] / 2) + (rigid[i + 1] ? 0.0 : lengths[i + 1] / 2);
    if (total > 0) result[i] = cell / total;
  }
  return result;
}

bool predict(Rope& rope) {
  predict(rope.rods, {&rope});
  return rope.rods.solved == 1.0;
}

double distance(const Body& body, const Point& at) { return field_of(body, at).distance; }

bool take_step(Rope& rope) {
  take_step(rope.rods, {&rope});
  return rope.rods.solved == 1.0;
}

}  // namespace dlo
