// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// The loads that a DLO bears on its way: the sharpest bend, the largest tension and the largest strain.
//
// The curvature at a node is the change of the unit tangent per length that bends there.  The tension is that
// of the spring of a segment, see `find_tensions`, and the share of the bending forces along it: the energy of a
// joint, w / 2 |b|^2 with the bend b, is that of tangents divided by the rest length, so that it also resists
// stretching, with w |b|^2 / (2 l).  In a bend of radius r, this is EI / r^2, by which the springs are shorter
// where nothing pulls.  A hand that holds a node bears the tension and the weight of the half segment between
// them.  The strain is the tension of a segment divided by EA.
//
// Hands of a script change their speed within one step, which no hand can: the shock is up to
// v sqrt(EA m / L).  So tensions are smoothed over `kSlow` until the hands have been steady that long, as if
// they took that time to change their speed, and later only as far as chatter of contact needs.  At the start,
// the springs of a measured DLO are not in balance with its weight; they get time for that, too.

namespace dlo {
namespace DLO_TARGET {

constexpr double kSlow = 0.05, kFast = 0.01;  // s
constexpr double kBalance = 0.5;              // s; until then a measured start is hardly in balance
constexpr double kJerk = 2.0;                 // m/s^2; a hand that is faster accelerated is not steady

/// Measures the loads of one DLO after each step.
class LoadMeter {
 public:
  /// Measure the DLO of a lane after a step; `rope` has its properties, and what holds it.
  template <class Number>
  void measure(Rods<Number>& rods, int lane, const Rope& rope) {
    const Rods<double>& properties = rope.rods;
    const int segments = properties.nodes - 1;
    springs_.resize(segments, 0.0), tensions_.resize(segments), tangents_.resize(segments);
    lengths_.resize(segments);
    hold(rope, properties.step);
    const double time = steady_ < kSlow ? kSlow : kFast, gain = properties.step / (time + properties.step);
    now_ = {};
    for (int i = 0; i < segments; ++i) {
      const Point segment = in_lane(rods.points[i + 1], lane) - in_lane(rods.points[i], lane);
      const double length = sqrt(dot(segment, segment));
      tangents_[i] = 1.0 / length * segment;
      lengths_[i] = is_rigid(i) ? 0.0 : length;
      // Where a hand holds both ends, it bears the forces.
      springs_[i] = is_rigid(i) ? 0.0 : springs_[i] + gain * (in_lane(rods.tensions[i], lane) - springs_[i]);
      tensions_[i] = springs_[i];
    }
    const auto& rests = properties.rest_lengths;
    for (int i = 0; i + 1 < segments; ++i) {
      const Point bend = tangents_[i + 1] - tangents_[i];
      const double square = dot(bend, bend), length = (lengths_[i] + lengths_[i + 1]) / 2;
      if (length > 0.0) raise(now_.curvature, sqrt(square) / length, i + 1.0);
      const double torque = properties.bending[i][2] * rests[i] * rests[i + 1] * square / 2;
      tensions_[i] += torque / rests[i], tensions_[i + 1] += torque / rests[i + 1];
    }
    for (int i = 0; i < segments; ++i)
      if (!is_rigid(i)) {
        raise(now_.strain, tensions_[i] / (properties.stiffness[i] * rests[i]), i + 0.5);
        raise(now_.tension, tensions_[i], i + 0.5);
      }
    for (int node : held_) {
      if (node > 0 && !is_rigid(node - 1)) bear(properties, node, node - 1, -1.0);
      if (node < segments && !is_rigid(node)) bear(properties, node, node, 1.0);
    }
    raise(most_.curvature, now_.curvature), raise(most_.tension, now_.tension);
    raise(most_.strain, now_.strain);
  }

  /// Return the largest loads since the last call, at least those of now.
  Loads take() {
    const Loads most = most_;
    most_ = now_;
    return most;
  }

 private:
  static void raise(Load& most, double value, double place) {
    if (value > most.value) most = {value, place};
  }
  static void raise(Load& most, const Load& load) { raise(most, load.value, load.place); }

  bool is_rigid(int segment) const { return is_held_[segment] && is_held_[segment + 1]; }

  /// Add the tension at a held node, beside a segment that leaves it in the direction `sign`.
  void bear(const Rods<double>& properties, int node, int segment, double sign) {
    const auto& rests = properties.rest_lengths;
    const int other = sign > 0.0 ? segment - 1 : segment + 1;
    const bool end = other < 0 || other >= static_cast<int>(rests.size());
    const double share = end ? 1.0 : rests[segment] / (rests[segment] + rests[other]);
    const double weight = share * properties.masses[node] * dot(properties.gravity, tangents_[segment]);
    raise(now_.tension, tensions_[segment] + sign * weight, node);
  }

  /// Take what holds the rope in this step, and for how long that has been steady.
  void hold(const Rope& rope, double step) {
    bool steady = rope.held == held_;
    for (std::size_t h = 0; steady && h < held_.size(); ++h) {
      const Point change = rope.hand_velocities[h] - velocities_[h];
      steady = dot(change, change) <= kJerk * step * kJerk * step;
    }
    if (!steady) steady_ = min(steady_, 0.0);
    steady_ += step;
    held_ = rope.held, velocities_ = rope.hand_velocities;
    is_held_.assign(rope.rods.nodes, false);
    for (int node : held_) is_held_[node] = true;
  }

  std::vector<double> springs_, tensions_, lengths_;  // of the segments: smoothed [N]; [N]; that bend [m]
  std::vector<Point> tangents_;
  std::vector<int> held_;
  std::vector<char> is_held_;
  std::vector<Point> velocities_;  // of held nodes [m/s]
  double steady_ = -kBalance;      // [s]
  Loads now_, most_;
};

}  // namespace DLO_TARGET
}  // namespace dlo
