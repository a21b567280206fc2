// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// A step: the physical terms in their order.  These headers are compiled once per target.

#include "arithmetic.hpp"
#include "self_contact.hpp"
#include "rod.hpp"
#include "strands.hpp"
#include "moments.hpp"
#include "frame.hpp"
#include "shapes.hpp"
#include "scene_contact.hpp"

namespace dlo {
namespace DLO_TARGET {

/// Call `act` for each held node, with its lane, index, velocity and target.
template <class Act>
inline void each_held(const Ropes& ropes, Act act) {
  for (std::size_t lane = 0; lane < ropes.size(); ++lane) {
    const Rope& rope = *ropes[lane];
    for (std::size_t h = 0; h < rope.held.size(); ++h)
      act(static_cast<int>(lane), rope.held[h], rope.hand_velocities[h], rope.targets[h]);
  }
}

/// Give held nodes the velocities of their hands.
template <class Number>
inline void hold(Rods<Number>& rods, const Ropes& ropes) {
  std::fill(rods.any_held.begin(), rods.any_held.end(), false);
  each_held(ropes, [&](int lane, int node, const Point& velocity, const Point&) {
    Holding<Number>& holding = rods.holding[node];
    if (!rods.any_held[node]) holding = {}, rods.any_held[node] = true;
    const double weight = kHeld * in_lane(rods.masses[node], lane);
    in_lane(holding.weight, lane) += weight;
    set_lane(holding.impulse, lane, in_lane(holding.impulse, lane) + weight * velocity);
  });
}

/// Compute the forces with which hands hold the nodes of a DLO in a lane: what its equations lack without them.
/// The hands of a script change their speed within one step, and contact chatters: so the forces are smoothed.
template <class Number>
inline void find_hand_forces(Rods<Number>& rods, Rope& rope, int lane) {
  constexpr double kSmoothing = 0.01;  // s
  const double gain = rods.step / (kSmoothing + rods.step);
  for (std::size_t h = 0; h < rope.held.size(); ++h) {
    const int node = rope.held[h];
    const Point missing = rope.hand_velocities[h] - in_lane(rods.predicted[node], lane);
    const Point force = kHeld * in_lane(rods.masses[node], lane) / rods.step * missing;
    rope.hand_forces[h] = rope.hand_forces[h] + gain * (force - rope.hand_forces[h]);
  }
}

/// Keep the DLO in a lane from passing through itself in the coming step.
template <class Number>
inline void avoid_self_contact(Rods<Number>& rods, Rope& rope, int lane) {
  std::vector<Point>& points = rope.rods.points;
  const auto copy = [&](std::vector<Vec3<Number>>& from, std::vector<Point>& to) {
    if constexpr (lanes_of<Number> > 1)
      for (int i = 0; i < rods.nodes; ++i) to[i] = in_lane(from[i], lane);
  };
  const auto moved = [&](std::array<Number, 2>& by) {
    return Movement{in_lane(by[0], lane), in_lane(by[1], lane)};
  };
  const auto current = [&] { return copy(rods.points, points), points.data(); };
  if (!is_near(rope.contact, moved(rods.last_moves), moved(rods.next_moves), current)) return;
  copy(rods.points, points), copy(rods.predicted, rope.rods.predicted), copy(rods.support, rope.rods.support);
  keep_apart(rope.contact, points.data(), rope.rods.predicted.data(), rods.nodes, rope.inverse_masses.data(),
             rope.rods.support.data(), rods.step);
  if constexpr (lanes_of<Number> > 1)
    for (int i = 0; i < rods.nodes; ++i) set_lane(rods.predicted[i], lane, rope.rods.predicted[i]);
}

/// Compute the velocities due to gravity, internal forces and self-contact, with the `targets` and `turns` of
/// each rope; `solved` becomes 0 where they are not finite.
template <class Number>
void predict(Rods<Number>& rods, const Ropes& ropes) {
  const double step = rods.step;
  for (std::size_t lane = 0; lane < ropes.size(); ++lane)
    for (std::size_t h = 0; h < ropes[lane]->held.size(); ++h) {
      const Point way = ropes[lane]->targets[h] - in_lane(rods.points[ropes[lane]->held[h]], lane);
      ropes[lane]->hand_velocities[h] = {way.x / step, way.y / step, way.z / step};
    }
  constexpr bool kTogether = lanes_of<Number> > 1;  // then each rope has taken its first step
  const bool rubbed = kTogether || ropes[0]->strands_begun;
  if (rods.strands_rub && !strands_turn(rods)) find_strand_forces(rods, rubbed);
  find_springs(rods);
  if (rods.framed) {
    add_frame(rods, ropes, kTogether || ropes[0]->frame_begun, rubbed);
    ropes[0]->frame_begun = true;
  }
  if (rods.strands_rub) ropes[0]->strands_begun = true;
  hold(rods, ropes);
  const auto has_scene = [](const Rope* rope) { return rope->surroundings.scene != nullptr; };
  if (std::any_of(ropes.begin(), ropes.end(), has_scene)) solve_among_bodies(rods, ropes);
  else solve(rods);
  for (std::size_t lane = 0; lane < ropes.size(); ++lane)
    find_hand_forces(rods, *ropes[lane], static_cast<int>(lane));
  each_held(ropes, [&](int lane, int node, const Point& velocity, const Point&) {
    set_lane(rods.predicted[node], lane, velocity);
  });
  if (rods.measured) find_tensions(rods);
  rods.last_moves = movement(rods.velocities, step);
  rods.next_moves = movement(rods.predicted, step);
  for (std::size_t lane = 0; lane < ropes.size(); ++lane) {
    turn_clamps(*ropes[lane]);
    if (in_lane(rods.solved, lane) != 1.0) continue;
    avoid_self_contact(rods, *ropes[lane], static_cast<int>(lane));
    keep_out(rods, *ropes[lane], static_cast<int>(lane));
  }
}

/// Take a step on a table, among the bodies of a scene.
template <class Number>
void take_step(Rods<Number>& rods, const Ropes& ropes) {
  predict(rods, ropes);
  step_on_table(rods);
  for (std::size_t lane = 0; lane < ropes.size(); ++lane)
    add_support(rods, *ropes[lane], static_cast<int>(lane));
  each_held(ropes, [&](int lane, int node, const Point& velocity, const Point& target) {
    set_lane(rods.velocities[node], lane, velocity);
    set_lane(rods.support[node], lane, {0.0, 0.0, 0.0});
    set_lane(rods.points[node], lane, target);
  });
}

}  // namespace DLO_TARGET
}  // namespace dlo
