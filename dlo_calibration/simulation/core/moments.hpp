// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Moments in the material frame: natural curvature, locking, and friction between strands.
//
// A cable of strands locks: where it is bent far, its strands press on each other, and it becomes stiffer.
// With the strain e, the curvature less the natural curvature, and the radius r, `locking`, the moment is
// EI e (1 + min(r^2 |e|^2, kLocked)), a Duffing spring (Duffing, Erzwungene Schwingungen, 1918).  The bound
// stands for strands that hold together as one rod.
//
// Where a DLO resists twist, its strands turn with its material.  Then the plastic bend of strands.hpp has
// two components in the material frame, at the mean angle of both segments, in place of a vector that turns
// by the smallest rotation.  So a bent DLO that turns about its axis rubs, too, and the moment of friction
// turns the frame.

namespace dlo {
namespace DLO_TARGET {

constexpr double kLocked = 30.0;     // largest stiffening by locking
constexpr double kSoftest = 1e-200;  // N m; avoids divisions by zero

/// Whether the strands of a DLO turn with its material frame.
template <class Number>
inline bool strands_turn(const Rods<Number>& rods) {
  return rods.strands_rub && rods.framed && rods.twists;
}

/// A vector in the Bishop frame, from its components in the material frame.
template <class Number>
inline std::array<Number, 2> turned(const Number& x, const Number& y, const Joint<Number>& joint) {
  return {x * joint.cosine - y * joint.sine, x * joint.sine + y * joint.cosine};
}

/// Compute `stiffening` and `stiffened`.
template <class Number>
inline void find_stiffening(Rods<Number>& rods) {
  const int joints = rods.nodes - 2;
  const auto* all_joints = rods.joints.data();
  const auto* natural = rods.natural.data();
  const auto* all_locking = rods.locking.data();
  for (int i = 0; i < joints; ++i) {
    const Joint<Number>& joint = all_joints[i];
    const Locking<Number>& locking = all_locking[i];
    const auto [x, y] = turned(natural[i].x, natural[i].y, joint);
    const Number inverse = 1.0 / max(locking.stiffness, kSoftest);
    const Number strain_x = joint.x - x * inverse, strain_y = joint.y - y * inverse;
    const Number more = min((strain_x * strain_x + strain_y * strain_y) * locking.scale, kLocked);
    const Number all = 1.0 + more;
    rods.stiffening[i] = more;
    rods.stiffened[i] = {natural[i].x * all, natural[i].y * all, natural[i].size * all};
  }
}

/// The natural curvature, as locking changes it.
template <class Number>
inline const Natural<Number>* natural_now(const Rods<Number>& rods) {
  return (rods.locks ? rods.stiffened : rods.natural).data();
}

/// Compute `moments`.  `follow`: the plastic bend follows the bend, and strands that are going to slip have
/// their secant stiffness, see strands.hpp.
template <class Number>
inline void find_moments(Rods<Number>& rods, bool begun, bool follow) {
  const int joints = rods.nodes - 2;
  const auto* all_joints = rods.joints.data();
  const auto* natural = natural_now(rods);
  const auto* all_strands = rods.strands.data();
  const bool locks = rods.locks, rubs = strands_turn(rods);
  auto* bends = rods.plastic.data();
  auto* moments = rods.moments.data();
  const Number none{};
  for (int i = 0; i < joints; ++i) {
    const Joint<Number>& joint = all_joints[i];
    Moment<Number>& moment = moments[i];
    const Vec3<Number> bend{joint.cosine * joint.x + joint.sine * joint.y,
                            joint.cosine * joint.y - joint.sine * joint.x, none};
    moment = {natural[i].x, natural[i].y, none};
    if (locks) {
      const Number more = rods.locking[i].stiffness * rods.stiffening[i];
      moment.x = moment.x - more * bend.x, moment.y = moment.y - more * bend.y;
    }
    if (!rubs) continue;
    const Strands<Number>& strands = all_strands[i];
    PlasticBend<Number>& plastic = bends[i];
    Vec3<Number> strain{}, coming{};
    if (begun) {
      strain = bend - plastic.bend;
      coming = kImplicit * (strain - plastic.strain);
      strain = limited(strain, strands.slip) * strain;
    }
    Number stiffness = strands.stiffness;
    moment.x = moment.x - stiffness * strain.x, moment.y = moment.y - stiffness * strain.y;
    if (follow) {
      plastic.bend = bend - strain, plastic.strain = strain;
      stiffness = stiffness * limited(strain + coming, strands.slip);
    }
    moment.stiffness = stiffness;
  }
}

/// Add the stiffness of strands that turn, and of locking, to the equations of the nodes.
template <class Number>
inline void add_stiffness(Rods<Number>& rods) {
  const int joints = rods.nodes - 2;
  const double implicit = kImplicit * rods.step * rods.step;
  const bool locks = rods.locks, rubs = strands_turn(rods);
  const auto* inverse_lengths = rods.inverse_lengths.data();
  const auto* moments = rods.moments.data();
  auto* forces = rods.strand_forces.data();
  if (rubs || !rods.strands_rub)  // else the strands have written theirs
    std::fill(rods.strand_forces.begin(), rods.strand_forces.end(), StrandForce<Number>{});
  const Number none{};
  Number next = none, beside_next = none, after = none;  // of the joints so far, see strands.hpp
  for (int i = 0; i < joints; ++i) {
    auto& row = forces[i].matrix;
    row[0] = row[0] + next, row[1] = row[1] + beside_next;
    next = after, beside_next = after = none;
    const auto add = [&](const Number& weight, const Number& r0, const Number& r1, const Number& r2) {
      row[0] = row[0] + weight * r0 * r0, row[1] = row[1] + weight * r0 * r1, row[2] = row[2] + weight * r0 * r2;
      next = next + weight * r1 * r1, beside_next = beside_next + weight * r1 * r2;
      after = after + weight * r2 * r2;
    };
    if (rubs) {
      const auto& [r0, r1, r2] = rods.strands[i].row;
      add(implicit * moments[i].stiffness, r0, r1, r2);
    }
    if (locks) {  // its stiffness may be large, so that the present lengths count
      const Number r0 = inverse_lengths[i], r2 = inverse_lengths[i + 1];
      add(implicit * 3.0 * (rods.locking[i].stiffness * rods.stiffening[i]), r0, -(r0 + r2), r2);
    }
  }
  auto &before = forces[joints].matrix, &last = forces[joints + 1].matrix;
  before[0] = before[0] + next, before[1] = before[1] + beside_next, last[0] = last[0] + after;
}

}  // namespace DLO_TARGET
}  // namespace dlo
