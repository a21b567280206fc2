// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Friction between the strands of a cable: an elastic, perfectly plastic element parallel to the elastic
// bending stiffness (Iwan, A Distributed-Element Model for Hysteresis, 1966).
//
// Its state is the plastic bend p_i, at which it has no stress; the DLO starts there.  The strain
// e = t_i - t_(i-1) - p_i causes the moment k EI e / l, and where |e| exceeds l slip, p_i follows.  p_i turns
// with the DLO by the smallest rotation.  The nodes that turn it bear the torque; otherwise the element would
// gain energy.

namespace dlo {
namespace DLO_TARGET {

constexpr double kHairpin = 0.01;  // least squared cosine of half an angle between segments: limits divisions
constexpr double kImplicit = 0.6;  // c of friction between strands, relative to the squared time step

/// The factor that shortens a vector to the length `longest`; 1 if it is not longer.
template <class Number>
inline Number limited(const Vec3<Number>& v, Number longest) {
  const Number square = dot(v, v);
  const auto longer = square > longest * longest;
  Number share = Number{} + 1.0;
  if (any(longer)) share = select(longer, longest / sqrt(square), share);
  return share;
}

/// 1 / `square`, the squared length of the sum of two unit vectors that are nearly parallel.
template <class Number>
inline Number inverse_of(Number square) {
  const Number away = 1.0 - square / 4;
  Number inverse = (1.0 + away * (1.0 + away * (1.0 + away))) / 4;
  const auto far = away > 1e-4;
  if (any(far)) inverse = select(far, 1.0 / max(square, 4 * kHairpin), inverse);
  return inverse;
}

/// Compute `strand_forces`, what friction between strands adds to the equations of the nodes.
///
/// The plastic bend turns by the smallest rotation of the mean tangent.  Where the strands are going to slip
/// in this step, the secant stiffness is used: a larger stiffness would brake too much, a smaller one
/// rattle.
template <class Number>
inline void find_strand_forces(Rods<Number>& rods, bool begun) {
  const int inner = rods.nodes - 2;
  const auto* points = rods.points.data();
  const auto* all_strands = rods.strands.data();
  auto* bends = rods.plastic.data();
  StrandForce<Number>* forces = rods.strand_forces.data();
  const double step = rods.step, implicit = kImplicit * step * step;
  // Three loops, so that the processor works on several nodes at the same time.
  for (int i = 0; i < inner; ++i) {  // turn the plastic bend with the tangent
    const Vec3<Number> chord = points[i + 2] - points[i];
    const Number inverse = 1.0 / sqrt(dot(chord, chord));
    const Vec3<Number> tangent = inverse * chord;
    PlasticBend<Number>& plastic = bends[i];
    if (begun) {
      const Number along = 2 * dot(plastic.tangent, plastic.bend);
      const Vec3<Number> sum = plastic.tangent + tangent;
      const Number share = dot(sum, plastic.bend) * inverse_of(dot(sum, sum)) * 2;
      plastic.bend = plastic.bend + along * tangent - share * sum;
    }
    plastic.tangent = inverse * chord;
    forces[i].matrix[0] = inverse;
  }
  for (int i = 0; i < inner; ++i) {  // let it follow the bend
    const Strands<Number>& strands = all_strands[i];
    PlasticBend<Number>& plastic = bends[i];
    const auto& [r0, r1, r2] = strands.row;
    const Vec3<Number> bend = r0 * points[i] + r1 * points[i + 1] + r2 * points[i + 2];
    Vec3<Number> strain{}, coming{};
    if (begun) {
      strain = bend - plastic.bend;
      coming = kImplicit * (strain - plastic.strain);
      strain = limited(strain, strands.slip) * strain;
    }
    plastic.bend = bend - strain, plastic.strain = strain;
    forces[i].matrix[1] = strands.stiffness * limited(strain + coming, strands.slip);
  }
  // Contributions of the joints so far to the next two nodes.
  const Number none{};
  Number next = none, beside_next = none, after = none;  // diagonals, and the entry below the first diagonal
  Vec3<Number> next_impulse{}, after_impulse{};
  for (int i = 0; i < inner; ++i) {
    const auto& [r0, r1, r2] = all_strands[i].row;
    const auto& [bend, tangent, strain] = bends[i];
    const Number inverse = forces[i].matrix[0], stiffness = forces[i].matrix[1];
    const Number weight = implicit * stiffness;
    const Vec3<Number> moment = step * stiffness * strain;
    // The plastic bend turns with the outer nodes, so that they bear the torque on it.
    const Number along = inverse * dot(bend, tangent), share = inverse * dot(moment, tangent);
    const Vec3<Number> torque = along * moment - share * bend;
    forces[i].matrix = {next + weight * r0 * r0, beside_next + weight * r0 * r1, weight * r0 * r2};
    forces[i].impulse = next_impulse + r0 * moment + torque;
    next = after + weight * r1 * r1, beside_next = weight * r1 * r2, after = weight * r2 * r2;
    next_impulse = after_impulse + r1 * moment;
    after_impulse = r2 * moment - torque;
  }
  // The other entries stay zero.
  forces[inner].matrix[0] = next, forces[inner].matrix[1] = beside_next, forces[inner].impulse = next_impulse;
  forces[inner + 1].matrix[0] = after, forces[inner + 1].impulse = after_impulse;
}

}  // namespace DLO_TARGET
}  // namespace dlo
