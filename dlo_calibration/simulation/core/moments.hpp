// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Moments in the material frame: natural curvature, and friction between strands.
//
// Where a DLO resists twist, its strands turn with its material.  Then the plastic bend of strands.hpp has
// two components in the material frame, at the mean angle of both segments, in place of a vector that turns
// by the smallest rotation.  So a bent DLO that turns about its axis rubs, too, and the moment of friction
// turns the frame.

namespace dlo {
namespace DLO_TARGET {

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

/// Compute `moments`.  `follow`: the plastic bend follows the bend, and strands that are going to slip have
/// their secant stiffness, see strands.hpp.
template <class Number>
inline void find_moments(Rods<Number>& rods, bool begun, bool follow) {
  const int joints = rods.nodes - 2;
  const auto* all_joints = rods.joints.data();
  const auto* natural = rods.natural.data();
  const auto* all_strands = rods.strands.data();
  auto* bends = rods.plastic.data();
  auto* moments = rods.moments.data();
  const Number none{};
  for (int i = 0; i < joints; ++i) {
    const Joint<Number>& joint = all_joints[i];
    const Strands<Number>& strands = all_strands[i];
    PlasticBend<Number>& plastic = bends[i];
    const Vec3<Number> bend{joint.cosine * joint.x + joint.sine * joint.y,
                            joint.cosine * joint.y - joint.sine * joint.x, none};
    Vec3<Number> strain{}, coming{};
    if (begun) {
      strain = bend - plastic.bend;
      coming = kImplicit * (strain - plastic.strain);
      strain = limited(strain, strands.slip) * strain;
    }
    Number stiffness = strands.stiffness;
    moments[i].x = natural[i].x - stiffness * strain.x, moments[i].y = natural[i].y - stiffness * strain.y;
    if (follow) {
      plastic.bend = bend - strain, plastic.strain = strain;
      stiffness = stiffness * limited(strain + coming, strands.slip);
    }
    moments[i].stiffness = stiffness;
  }
}

/// Add the stiffness of `moments` to the equations of the nodes.
template <class Number>
inline void add_stiffness(Rods<Number>& rods) {
  const int joints = rods.nodes - 2;
  const double implicit = kImplicit * rods.step * rods.step;
  const auto* all_strands = rods.strands.data();
  const auto* moments = rods.moments.data();
  auto* forces = rods.strand_forces.data();
  const Number none{};
  Number next = none, beside_next = none, after = none;  // of the joints so far, see strands.hpp
  for (int i = 0; i < joints; ++i) {
    const auto& [r0, r1, r2] = all_strands[i].row;
    const Number weight = implicit * moments[i].stiffness;
    forces[i].matrix = {next + weight * r0 * r0, beside_next + weight * r0 * r1, weight * r0 * r2};
    forces[i].impulse = {};
    next = after + weight * r1 * r1, beside_next = weight * r1 * r2, after = weight * r2 * r2;
  }
  forces[joints] = {{next, beside_next, none}, {}}, forces[joints + 1] = {{after, none, none}, {}};
}

}  // namespace DLO_TARGET
}  // namespace dlo
