// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// The contact of a DLO with the fixed bodies of a scene in a step.
//
// Contact is part of the implicit equations, as a hand is: a body that pushes adds n . v = v_n with a large
// weight.  Impulses found after the solution instead would reach the neighbouring nodes a step late, so that
// the tension along a DLO around a peg would be wrong.  Coulomb friction is a drag of mu p / |v_t| against the
// sliding velocity v_t, p being the impulse along the normal: a symmetric term, which only takes energy.
// Which bodies push, and v_t, come from the last solution; where they change, the equations are solved again
// (an active set, and iteratively reweighted friction).

namespace dlo {
namespace DLO_TARGET {

constexpr double kRigid = 1e6;        // weight of the equation of a contact, relative to the mass that it moves
constexpr double kCreep = 1e-6;       // m/s; slower sliding counts as none
constexpr double kFrictionError = 0.1;  // share of the largest friction by which it may be late
constexpr int kSolutions = 4, kMostSolutions = 10;  // of the equations of a step; the later ones only release
constexpr double kLeft = 1e-4;        // m; a gap with which the DLO has left a body
constexpr double kCorrected = 0.08;   // share of a penetration that one step corrects, as on the table
constexpr double kAllowed = 1e-5;     // m of penetration, as on the table

/// Find the segments and bodies whose gap is below `reach` [m].
inline void find_near(SceneContact& contact, const Point* points, int nodes, double reach) {
  contact.near.clear();
  contact.moved = 0.0, contact.least_room = HUGE_VAL;
  const std::vector<Body>& scene = contact.scene->bodies;
  Point low = points[0], high = points[0];
  double longest = 0.0;
  for (int i = 1; i < nodes; ++i) {
    const Point segment = points[i] - points[i - 1];
    longest = max(longest, dot(segment, segment));
    low = {min(low.x, points[i].x), min(low.y, points[i].y), min(low.z, points[i].z)};
    high = {max(high.x, points[i].x), max(high.y, points[i].y), max(high.z, points[i].z)};
  }
  for (int k = 0; k < static_cast<int>(scene.size()); ++k) {
    const Body& body = scene[k];
    const double far = contact.radius + reach;
    const auto outside = [&](double at, double from, double to) {
      return max(max(from - at, at - to), 0.0);
    };
    const Point away = {outside(body.position.x, low.x, high.x), outside(body.position.y, low.y, high.y),
                        outside(body.position.z, low.z, high.z)};
    if (sqrt(dot(away, away)) > body.reach + far) continue;
    const double furthest = body.reach + far + 0.5 * sqrt(longest);
    for (int i = 0; i + 1 < nodes; ++i) {
      const Point middle = 0.5 * (points[i] + points[i + 1]), apart = middle - body.position;
      if (dot(apart, apart) > furthest * furthest) continue;
      const Point half = points[i + 1] - middle;
      const double beyond = field_of(body, middle).distance - sqrt(dot(half, half)) - far;
      if (beyond > 0.0) continue;
      contact.near.push_back({k, i, max(beyond + reach, 0.0)});
      contact.least_room = min(contact.least_room, contact.near.back().room);
    }
  }
}

/// Call `gap = act(body, node, share, field)` for each node of the near segments that can touch before any
/// node has moved by `coming` [m], and for each place between two nodes that is nearer to a body than both;
/// share < 0: it is the node.  Set their room.  `points(i)` returns a node.
template <class Points, class Act>
inline void each_place(SceneContact& contact, Points points, double coming, Act act) {
  int body = -1, node = -1;
  double gap = 0.0, least_room = HUGE_VAL;
  Field first{};
  if (contact.least_room > contact.moved + coming) return;
  for (Near& near : contact.near) {
    if (near.room > contact.moved + coming) {
      least_room = min(least_room, near.room);
      continue;
    }
    const int i = near.segment;
    const Body& at = contact.scene->bodies[near.body];
    const Point start = points(i), end = points(i + 1);
    if (near.body != body || i != node) {
      first = field_of(at, start);
      gap = act(near.body, i, -1.0, first);
    }
    const Field second = field_of(at, end);
    const Between between = nearest_between(at, start, end, first, second, contact.radius + coming);
    gap = min(gap, between.share < 0.0 ? between.field.distance - contact.radius
                                       : act(near.body, i, between.share, between.field));
    const double next = act(near.body, i + 1, -1.0, second);
    near.room = contact.moved + max(min(gap, next), 0.0);
    least_room = min(least_room, near.room);
    body = near.body, node = i + 1, first = second, gap = next;
  }
  contact.least_room = least_room;
}

inline std::size_t place_of(const SceneContact& contact, int body, int node, bool between) {
  return 2 * (body * (contact.allowed.size() / (2 * contact.scene->bodies.size())) + node) + between;
}

/// Let what lies in a body at the start stay there.
inline void begin(SceneContact& contact, const Point* points, int nodes) {
  find_near(contact, points, nodes, 0.0);
  const auto at = [&](int i) { return points[i]; };
  each_place(contact, at, HUGE_VAL, [&](int body, int node, double share, const Field& field) {
    const double gap = field.distance - contact.radius;
    if (!(gap < 0.0)) return gap;
    if (contact.allowed.empty()) contact.allowed.assign(2 * contact.scene->bodies.size() * nodes, 0.0);
    double& allowed = contact.allowed[place_of(contact, body, node, share >= 0.0)];
    allowed = min(allowed, gap);
    return gap;
  });
  contact.near.clear();
}

/// Find the places that may touch a body before a node has moved by `coming` [m]; those that touched it in the
/// last step keep their state.
template <class Points>
inline void find_touches(SceneContact& contact, Points points, const double* inverse_masses, double step,
                         double coming) {
  contact.former.swap(contact.touches);
  contact.touches.clear();
  auto last = contact.former.begin();
  each_place(contact, points, coming, [&](int body, int node, double share, const Field& field) {
    const bool between = share >= 0.0;
    double gap = field.distance - contact.radius;
    if (!contact.allowed.empty()) {
      double& allowed = contact.allowed[place_of(contact, body, node, between)];
      allowed = max(allowed, min(gap, 0.0));
      gap -= allowed;
    }
    Touch touch{body, node, between, {1.0, 0.0}, field.gradient, 0.0, 0.0};
    if (between) touch.weights = {1.0 - share, share};
    touch.mobility = touch.weights[0] * touch.weights[0] * inverse_masses[node];
    if (between) touch.mobility += touch.weights[1] * touch.weights[1] * inverse_masses[node + 1];
    if (!(touch.mobility > 0.0)) return gap;  // a hand holds it
    touch.least = gap > -kAllowed ? -(gap + kAllowed) / step : -kCorrected * (gap + kAllowed) / step;
    const auto key = [&](const Touch& t) { return 2 * (t.body * 1LL * kMostNodes + t.node) + t.between; };
    while (last != contact.former.end() && key(*last) < key(touch)) ++last;
    if (last != contact.former.end() && key(*last) == key(touch))
      touch.pushes = last->pushes && gap < kLeft, touch.drag = last->drag;
    contact.touches.push_back(touch);
    return gap;
  });
}

/// Write what the bodies that push a DLO add to the equations of its lane.
template <class Number>
inline void write_touches(Rods<Number>& rods, const SceneContact& contact, int lane) {
  for (int i = 0; i < rods.nodes; ++i)
    if (rods.any_touching[i]) {
      auto& to = rods.touching[i];
      for (int c = 0; c < 6; ++c) in_lane(to.own[c], lane) = in_lane(to.next[c], lane) = 0.0;
      set_lane(to.impulse, lane, {0.0, 0.0, 0.0});
    }
  for (const Touch& touch : contact.touches) {
    if (!touch.pushes) continue;
    const double rigid = kRigid / touch.mobility, more = rigid - touch.drag;
    const auto& [x, y, z] = touch.normal;
    const std::array<double, 6> matrix = {more * x * x + touch.drag, more * x * y, more * x * z,
                                          more * y * y + touch.drag, more * y * z, more * z * z + touch.drag};
    const auto add = [&](int node, double own, double next, double weight) {
      if (!rods.any_touching[node]) rods.touching[node] = {}, rods.any_touching[node] = true;
      auto& to = rods.touching[node];
      for (int c = 0; c < 6; ++c) {
        in_lane(to.own[c], lane) += own * matrix[c];
        in_lane(to.next[c], lane) += next * matrix[c];
      }
      set_lane(to.impulse, lane, in_lane(to.impulse, lane) + weight * rigid * touch.least * touch.normal);
    };
    const double a = touch.weights[0], b = touch.weights[1];
    add(touch.node, a * a, a * b, a);
    if (touch.between) add(touch.node + 1, b * b, 0.0, b);
  }
}

/// The velocity at a place.
template <class Number>
inline Point velocity_at(const Touch& touch, std::vector<Vec3<Number>>& velocities, int lane) {
  Point velocity = touch.weights[0] * in_lane(velocities[touch.node], lane);
  if (touch.between) velocity = velocity + touch.weights[1] * in_lane(velocities[touch.node + 1], lane);
  return velocity;
}

/// Take from a solution which bodies push and how the DLO slides; return whether that needs another solution.
/// A body that pulls always does; friction only at `first`, as it follows from step to step; nothing else
/// does at `last`.
template <class Number>
inline bool learn(Rods<Number>& rods, SceneContact& contact, int lane, bool first, bool last) {
  bool changed = false;
  for (Touch& touch : contact.touches) {
    const Point velocity = velocity_at(touch, rods.predicted, lane);
    const double approach = dot(velocity, touch.normal);
    const Point sliding = velocity - approach * touch.normal;
    const double speed = sqrt(dot(sliding, sliding)), rigid = kRigid / touch.mobility;
    const double coefficient = contact.friction * contact.scene->bodies[touch.body].friction;
    if (!touch.pushes) {
      if (last || !(approach < touch.least)) continue;
      touch.pushes = changed = true;
      touch.push = (touch.least - approach) / touch.mobility;
      touch.drag = coefficient * touch.push / max(speed, kCreep);
      continue;
    }
    touch.push = rigid * (touch.least - approach);
    if (touch.push < 0.0) {
      touch.pushes = false, changed = true;
      continue;
    }
    touch.impulse = touch.push * touch.normal - touch.drag * sliding;
    // If friction has held the DLO with more than it can, the speed is at most that of the mass alone.
    const double limit = coefficient * touch.push, beyond = touch.drag * speed - limit;
    const double other = limit / max(max(speed, beyond * touch.mobility), kCreep);
    changed = changed || (first && abs(other - touch.drag) * speed > kFrictionError * limit);
    touch.drag = other;
  }
  return changed;
}

/// Solve the equations of a step with the bodies around each DLO.
template <class Number>
inline void solve_among_bodies(Rods<Number>& rods, const Ropes& ropes) {
  std::fill(rods.any_touching.begin(), rods.any_touching.end(), false);
  const double step = rods.step;
  const auto furthest = [&](const std::vector<Vec3<Number>>& velocities) {
    Number squares{};
    for (const auto& velocity : velocities) squares = max(squares, dot(velocity, velocity));
    return step * sqrt(squares);
  };
  Number moved = furthest(rods.velocities);
  std::array<bool, kLanes> open{};
  const auto current = [&](Rope& rope, int lane) {
    if constexpr (lanes_of<Number> > 1)
      for (int i = 0; i < rods.nodes; ++i) rope.rods.points[i] = in_lane(rods.points[i], lane);
    return rope.rods.points.data();
  };
  const auto find = [&](Rope& rope, int lane, double by) {
    find_touches(rope.surroundings, [&](int i) { return in_lane(rods.points[i], lane); },
                 rope.inverse_masses.data(), step, by);
  };
  for (std::size_t lane = 0; lane < ropes.size(); ++lane) {
    SceneContact& contact = ropes[lane]->surroundings;
    if (!contact.scene) continue;
    open[lane] = true;
    contact.moved += in_lane(moved, lane);
    if (contact.near.empty()) continue;
    find(*ropes[lane], lane, in_lane(moved, lane));
    write_touches(rods, contact, lane);
  }
  solve(rods);
  Number coming = furthest(rods.predicted);
  for (int k = 1; ; ++k) {
    bool again = false;
    for (std::size_t lane = 0; lane < ropes.size(); ++lane) {
      Rope& rope = *ropes[lane];
      SceneContact& contact = rope.surroundings;
      if (!open[lane] || in_lane(rods.solved, lane) != 1.0) continue;
      if (k == 1) {
        const double by = in_lane(coming, lane);
        if (contact.room < contact.moved + by) {
          const double skin = min(max(kThinSkin, kSkinSteps * by), kThickSkin);
          contact.room = by + skin;
          find_near(contact, current(rope, lane), rods.nodes, contact.room);
          find(rope, lane, by);
        } else if (by > in_lane(moved, lane) && contact.least_room <= contact.moved + by) {
          const auto unseen = [&](const Near& near) {
            return near.room > contact.moved + in_lane(moved, lane) && near.room <= contact.moved + by;
          };
          if (std::any_of(contact.near.begin(), contact.near.end(), unseen)) find(rope, lane, by);
        }
      }
      open[lane] = learn(rods, contact, lane, k == 1, k >= kSolutions) && k < kMostSolutions;
      if (open[lane]) write_touches(rods, contact, lane);
      again = again || open[lane];
    }
    if (!again) return;
    solve(rods);
  }
}

/// Correct the predicted velocities where self-contact, or a solution that came too early, would push the DLO
/// into a body.
template <class Number>
inline void keep_out(Rods<Number>& rods, Rope& rope, int lane) {
  for (const Touch& touch : rope.surroundings.touches) {
    const double approach = dot(velocity_at(touch, rods.predicted, lane), touch.normal);
    if (!(approach < touch.least)) continue;
    const Point impulse = ((touch.least - approach) / touch.mobility) * touch.normal;
    for (int m = 0; m <= static_cast<int>(touch.between); ++m) {
      auto& velocity = rods.predicted[touch.node + m];
      const double by = touch.weights[m] * rope.inverse_masses[touch.node + m];
      set_lane(velocity, lane, in_lane(velocity, lane) + by * impulse);
    }
  }
}

/// Add to `support` what the bodies have changed.
template <class Number>
inline void add_support(Rods<Number>& rods, Rope& rope, int lane) {
  for (const Touch& touch : rope.surroundings.touches) {
    if (!touch.pushes) continue;
    for (int m = 0; m <= static_cast<int>(touch.between); ++m) {
      auto& support = rods.support[touch.node + m];
      const double by = touch.weights[m] * rope.inverse_masses[touch.node + m];
      set_lane(support, lane, in_lane(support, lane) + by * touch.impulse);
    }
  }
}

}  // namespace DLO_TARGET
}  // namespace dlo
