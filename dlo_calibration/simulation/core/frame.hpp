// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// The material frame: natural curvature and twist.
//
// Each segment has a material frame, turned by an angle from the Bishop frame, which has no twist (Bergou et
// al., Discrete Elastic Rods, 2008; Bishop, There is more than one way to frame a curve, 1975).  With natural
// curvature k, two components in the material frame, the bending energy becomes
// EI / (2 l) |t_i - t_(i-1) - l k_i|^2.  This is the energy of a straight DLO, a constant, and a mixed term,
// -EI k_i . (t_i - t_(i-1)), where k_i has the mean angle of both segments.  The twisting energy is
// GJ / (2 l) (angle_i - angle_(i-1))^2.  A DLO has almost no inertia about its axis, so that its angles
// minimise the energy: a clamp prescribes them, free ends and pins bear no torque.  With torsion 0, clamps do
// not prescribe them: the DLO turns freely as a whole and does not twist.  Where it twists, friction between
// strands belongs to the frame, see moments.hpp.

namespace dlo {
namespace DLO_TARGET {

constexpr double kTwoPi = 6.283185307179586;
constexpr double kRounded = 0.05;  // rad; mean bend below which the energy of curvature is rounded off
constexpr double kSteady = 0.01;   // rad; where bends are smaller, natural curvature turns the frame slowly
constexpr double kReach = 0.2;     // rad; largest turn of the material frame in a step
constexpr int kFirstTurns = 30;    // Newton steps at the start; later, one in each time step is enough

/// Transport `across` in parallel: by the smallest rotation that turns the tangent `before` to `tangent`.
template <class Number>
inline Vec3<Number> transported(Vec3<Number> across, const Vec3<Number>& before,
                                const Vec3<Number>& tangent) {
  const Number share = dot(across, tangent) / max(1.0 + dot(before, tangent), 2 * kHairpin);
  across = across - share * (before + tangent);
  across = across - dot(across, tangent) * tangent;  // zero except in a hairpin
  const Number length = sqrt(dot(across, across));
  return {across.x / length, across.y / length, across.z / length};
}

/// A unit vector perpendicular to a tangent.
inline Point perpendicular(const Point& t) {
  const double t_[3] = {t.x, t.y, t.z};
  int least = 0;
  for (int c = 1; c < 3; ++c)
    if (abs(t_[c]) < abs(t_[least])) least = c;
  const int second = (least + 1) % 3, third = (least + 2) % 3;
  const double length = sqrt(t_[second] * t_[second] + t_[third] * t_[third]);
  double result[3] = {};
  result[second] = t_[third] / length, result[third] = -t_[second] / length;
  return {result[0], result[1], result[2]};
}

/// Compute the Bishop frame, transported in time at the first segment and from there along the DLO, and the
/// bends between segments in it.
template <class Number>
inline void find_bishop_frame(Rods<Number>& rods, bool begun) {
  auto* all_joints = rods.joints.data();
  const int joints = rods.nodes - 2;
  auto *tangents = rods.tangents.data(), *across = rods.across.data();
  if (begun) rods.bishop[1] = transported(rods.bishop[1], rods.bishop[0], tangents[0]);
  else if constexpr (lanes_of<Number> == 1) rods.bishop[1] = perpendicular(tangents[0]);
  rods.bishop[0] = tangents[0];
  across[0] = rods.bishop[1];
  for (int i = 0; i < joints; ++i) {
    const Vec3<Number>&a = tangents[i], &b = tangents[i + 1], &u = across[i];
    Vec3<Number>& next = across[i + 1];
    Number square = (1.0 + a.x * b.x + a.y * b.y + a.z * b.z) / 2;
    const auto hairpin = square < kHairpin;
    if (any(hairpin)) square = select(hairpin, kHairpin, square);
    const Number inverse = 1.0 / sqrt(square);
    const Number x = dot(b, u) * inverse, y = dot(u, cross(b, a)) * inverse;
    Joint<Number>& joint = all_joints[i];
    joint.x = x, joint.y = y, joint.inverse = inverse, joint.half = inverse * square;
    next = u - x * (inverse / 2) * (a + b);
    if (any(hairpin)) {  // the line above was not quite a rotation
      const Vec3<Number> v = next - dot(next, b) * b, unit = 1.0 / sqrt(dot(v, v)) * v;
      next = {select(hairpin, unit.x, next.x), select(hairpin, unit.y, next.y),
              select(hairpin, unit.z, next.z)};
    }
  }
}

/// The bends [N m] in the direction of the natural curvature and across: sums over all joints.
template <class Number>
inline std::array<Number, 2> mean_direction(const Rods<Number>& rods) {
  Number along{}, across{};
  const auto* all_natural = natural_now(rods);
  for (std::size_t i = 0; i < rods.joints.size(); ++i) {
    const auto &natural = all_natural[i];
    const auto &joint = rods.joints[i];
    along = along + (natural.x * joint.x + natural.y * joint.y);
    across = across + (natural.x * joint.y - natural.y * joint.x);
  }
  return {along, across};
}

/// Turn the frame as a whole to the least energy, and compute the twisting moments.  With a and b of
/// `mean_direction`, the energy is -sqrt(a^2 + b^2).  `kRounded` rounds off its cusp at a straight DLO.
template <class Number>
inline void turn_freely(Rods<Number>& rods) {
  const int joints = rods.nodes - 2;
  auto* all_joints = rods.joints.data();
  const auto* natural = natural_now(rods);
  const auto [a, b] = mean_direction(rods);
  Number total{}, twist{}, slope{};
  for (int i = 0; i < joints; ++i) total = total + natural[i].size;
  const Number smallest = kRounded * total / static_cast<double>(joints);
  const Number ahead = select(total > 0.0, a, 1.0);  // without natural curvature, any direction is right
  const Number length = sqrt(ahead * ahead + b * b + smallest * smallest);
  const Number cosine = ahead / length, sine = b / length;
  for (int i = 0; i < joints; ++i) {
    Joint<Number>& joint = all_joints[i];
    joint.cosine = cosine, joint.sine = sine;
    const auto [x, y] = turned(natural[i].x, natural[i].y, joint);
    twist = twist + slope;  // no torque is left about the axis of a segment
    slope = (joint.x * y - joint.y * x) / 2;
    twist = twist + slope;
    joint.twist = twist;
  }
}

/// The angle [rad] by which a clamp turns its segment; a clamp that just closed does not turn it.
inline double turn_in(Clamp& clamp, const Point& t, const Point& u, double angle) {
  const Point v = cross(t, u);
  Point d = clamp.direction;
  if (!std::isfinite(d.x)) {
    const Rotation by = rotation(angle);
    d = by.cosine * u + by.sine * v;
  } else if (std::isfinite(clamp.tangent.x)) {  // parallel transport with the segment
    const Point& b = clamp.tangent;
    const double share = dot(d, t) / max(1.0 + b.x * t.x + b.y * t.y + b.z * t.z, 2 * kHairpin);
    d = d - share * (b + t);
  }
  clamp.direction = d, clamp.tangent = t;
  const double turn = angle_of(dot(d, v), dot(d, u)) - angle;
  return turn - kTwoPi * __builtin_nearbyint(turn / kTwoPi);
}

/// Turn clamps with their hands.
inline void turn_clamps(Rope& rope) {
  if (rope.turns.empty()) return;
  for (Clamp& clamp : rope.clamps) {
    clamp.direction = rope.turns[clamp.held] * clamp.direction;
    clamp.tangent = rope.turns[clamp.held] * clamp.tangent;
  }
}

/// Cosine and sine of the sum of two angles, from those of the first angle and the second angle [rad].
template <class Number>
inline std::array<Number, 2> added(const Number& cosine, const Number& sine, const Number& angle) {
  const Number q = angle * angle;
  Number c = 1 - q * (0.5 - q * (1.0 / 24)), s = angle * (1 - q * (1.0 / 6 - q * (1.0 / 120)));
  const auto large = abs(angle) > 0.01;
  if (any(large)) {
    Number exact_c = c, exact_s = s, second = angle;
    for (int lane = 0; lane < lanes_of<Number>; ++lane) {
      const Rotation by = rotation(in_lane(second, lane));
      in_lane(exact_c, lane) = by.cosine, in_lane(exact_s, lane) = by.sine;
    }
    c = select(large, exact_c, c), s = select(large, exact_s, s);
  }
  const Number x = cosine * c - sine * s, y = sine * c + cosine * s;
  const Number scale = 1.5 - (x * x + y * y) / 2;  // so that rounding does not add up
  return {scale * x, scale * y};
}

/// Turn the segments towards the balance of torques about their axes.
///
/// The energy is that of twist plus -|A| cos(delta) of natural curvature at each joint, with delta the mean
/// angle of both segments from the plane of the bend.  Where delta changes by less than `kReach`, a parabola
/// with the curvature |A| (cos(delta) + kReach / 3) is an upper bound, so that a Newton step of at most that
/// size lowers the energy.  Pivots of a matrix that is not positive definite are replaced (Nocedal and
/// Wright, Numerical Optimization, 2006, 3.4).  The curvature of friction between strands is that of
/// Gauss and Newton.
/// `begun`: if false, clamps of unknown direction do not hold yet.
template <class Number>
inline void balance_torques(Rods<Number>& rods, const Ropes& ropes, bool begun) {
  const int segments = rods.nodes - 1;
  const Number none{};
  auto *prescribed = rods.prescribed.data(), *turning = rods.turning.data(), *upper = rods.upper.data();
  auto *angles = rods.angles.data(), *clamped = rods.clamped.data();
  const auto* twisting = rods.twisting.data();
  const auto* natural = natural_now(rods);
  const bool rubs = strands_turn(rods) && begun;
  const auto* moments = rods.moments.data();
  auto* joints = rods.joints.data();
  const auto holds = [&](const Clamp& clamp) { return begun || std::isfinite(clamp.direction.x); };
  for (int i = 0; i < segments; ++i) clamped[i] = none;
  for (std::size_t lane = 0; lane < ropes.size(); ++lane)
    for (Clamp& clamp : ropes[lane]->clamps)
      if (holds(clamp)) {
        const int i = clamp.segment;
        in_lane(clamped[i], lane) = 1.0;
        in_lane(prescribed[i], lane) = turn_in(clamp, in_lane(rods.tangents[i], lane),
                                               in_lane(rods.across[i], lane), in_lane(angles[i], lane));
      }
  Number coupling = none, beyond = none, right = none, share = none, next_diagonal = none, next_right = none;
  for (int i = 0; i < segments; ++i) {
    Number diagonal = next_diagonal - share * beyond;
    right = next_right - share * right;
    coupling = none;
    if (i < segments - 1) {
      const Joint<Number> joint = joints[i];
      const Number stiffness = twisting[i];
      const auto [x, y] = turned(natural[i].x, natural[i].y, joint);
      Number slope = (joint.x * y - joint.y * x) / 2;
      Number curved = (x * joint.x + y * joint.y +
                       natural[i].size * (kReach / 3 * (abs(joint.x) + abs(joint.y)) + kSteady)) / 4;
      if (rubs) {
        const auto [all_x, all_y] = turned(moments[i].x, moments[i].y, joint);
        slope = (joint.x * all_y - joint.y * all_x) / 2;
        curved = curved + moments[i].stiffness * (joint.x * joint.x + joint.y * joint.y) / 4;
      }
      const Number torque = stiffness * (angles[i + 1] - angles[i]);
      coupling = curved - stiffness;
      next_diagonal = stiffness + curved, next_right = -torque - slope;
      diagonal = diagonal + next_diagonal;
      right = right + (torque - slope);
    }
    const Number beside = twisting[i > 0 ? i - 1 : 0];
    diagonal = select(diagonal < 1e-6 * beside, beside, diagonal);
    const auto held = clamped[i] > 0.0;
    diagonal = select(held, 1.0, diagonal), right = select(held, prescribed[i], right);
    beyond = select(held, 0.0, coupling);
    const Number inverse = 1.0 / diagonal;
    share = coupling * inverse;
    turning[i] = right * inverse, upper[i] = beyond * inverse;
  }
  Number largest = none + 2 * kReach;
  for (int i = segments - 2; i >= 0; --i) {
    turning[i] = turning[i] - upper[i] * turning[i + 1];
    largest = max(largest, abs(turning[i] + turning[i + 1]));
  }
  const auto far = largest > 2 * kReach;
  if (any(far)) {
    share = select(far, 2 * kReach / largest, 1.0);
    for (int i = 0; i < segments; ++i)
      turning[i] = select(clamped[i] > 0.0, prescribed[i], turning[i] * share);
  }
  for (int i = 0; i < segments; ++i) angles[i] = angles[i] + turning[i];
  for (int i = 0; i < segments - 1; ++i) {
    Joint<Number>& joint = joints[i];
    const auto [c, s] = added(joint.cosine, joint.sine, (turning[i] + turning[i + 1]) / 2);
    joint.cosine = c, joint.sine = s;
    joint.twist = twisting[i] * (angles[i + 1] - angles[i]);
  }
}

/// The energy [N m] of twist and natural curvature, less that of the straight DLO.
inline double frame_energy(const Rods<double>& rods) {
  double energy = 0.0;
  for (std::size_t i = 0; i < rods.joints.size(); ++i) {
    const Joint<double>& joint = rods.joints[i];
    const auto [x, y] = turned(rods.natural[i].x, rods.natural[i].y, joint);
    const double twist = rods.angles[i + 1] - rods.angles[i];
    energy += rods.twisting[i] * twist * twist / 2 - x * joint.x - y * joint.y;
  }
  return energy;
}

/// Compute the angles at the start: evenly twisted between clamps of known direction, else without twist.
/// `more` [rad] is added to the twist between two clamps.  Return that of the last two.
inline double begin_angles(Rods<double>& rods, const Ropes& ropes, double more) {
  auto& angles = rods.angles;
  const int segments = static_cast<int>(angles.size());
  const auto [along, across] = mean_direction(rods);
  angles.assign(segments, angle_of(across, along));
  int last = -1;
  double twist = 0.0;
  for (const Clamp& clamp : ropes[0]->clamps) {
    if (!std::isfinite(clamp.direction.x)) continue;
    const int j = clamp.segment;
    const Point &t = rods.tangents[j], &u = rods.across[j], &d = clamp.direction;
    const double angle = angle_of(dot(t, cross(u, d)), dot(u, d)), near = angles[last < 0 ? j : last];
    double there = angle + kTwoPi * __builtin_nearbyint((near - angle) / kTwoPi);
    if (last < 0) angles.assign(segments, there);
    else {
      if (j > last + 1) there += more, twist = there - near;
      for (int i = last; i < segments; ++i)
        angles[i] = angles[last] + (there - angles[last]) * min(1.0, double(i - last) / (j - last));
    }
    last = j;
  }
  for (int i = 0; i < segments - 1; ++i) {
    const double phi = (angles[i] + angles[i + 1]) / 2;
    const Rotation by = rotation(phi);
    rods.joints[i].cosine = by.cosine, rods.joints[i].sine = by.sine;
  }
  for (int k = 0; k < kFirstTurns; ++k) balance_torques(rods, ropes, false);
  return twist;
}

/// Compute the angles at the start.  The clamps' directions leave whole turns of the twist open: it is at most
/// half a turn, or one turn less if the energy is then less, as it is where a rest shape is twisted by nearly
/// half a turn.
inline void begin_frame(Rods<double>& rods, const Ropes& ropes) {
  const double twist = begin_angles(rods, ropes, 0.0);
  if (twist == 0.0) return;
  const auto angles = rods.angles;
  const auto joints = rods.joints;
  const auto clamps = ropes[0]->clamps;
  const double energy = frame_energy(rods);
  begin_angles(rods, ropes, twist > 0.0 ? -kTwoPi : kTwoPi);
  if (frame_energy(rods) < energy) return;
  rods.angles = angles, rods.joints = joints, ropes[0]->clamps = clamps;
}
inline void begin_frame(Rods<Lanes>&, const Ropes&) {}  // never called: a rope's first step is taken alone

/// The mean tangent at a joint, and the first director of the material frame there.
inline std::array<Point, 2> material(const Rods<double>& rods, int i) {
  const Point &a = rods.tangents[i], &b = rods.tangents[i + 1];
  const Point sum = a + b, tangent = 1.0 / max(sqrt(dot(sum, sum)), sqrt(kHairpin)) * sum;
  const Point across = transported(rods.across[i], a, tangent);
  return {tangent, rods.joints[i].cosine * across + rods.joints[i].sine * cross(tangent, across)};
}

/// From now on, the strands of a DLO turn with its material frame, which has just begun.
inline void enter_frame(Rods<double>& rods) {
  for (int i = 0; i < rods.nodes - 2; ++i) {
    const auto [tangent, first] = material(rods, i);
    const Point second = cross(tangent, first);
    for (auto* each : {&rods.plastic[i].bend, &rods.plastic[i].strain})
      *each = {dot(*each, first), dot(*each, second), 0.0};
  }
}
inline void enter_frame(Rods<Lanes>&) {}  // never called, as `begin_frame`

/// From now on, they do not.
inline void leave_frame(Rods<double>& rods) {
  find_springs(rods);
  find_bishop_frame(rods, true);
  for (int i = 0; i < rods.nodes - 2; ++i) {
    const auto [tangent, first] = material(rods, i);
    const Point second = cross(tangent, first);
    PlasticBend<double>& plastic = rods.plastic[i];
    for (auto* each : {&plastic.bend, &plastic.strain}) *each = each->x * first + each->y * second;
    plastic.tangent = tangent;
  }
}

/// Add the impulses [N s] of natural curvature, twist and strands that turn with the frame.
///
/// The forces are the exact gradient of the energy of segments that do not turn about their axes.  A couple
/// of forces at the ends of a segment replaces the torque on it.
template <class Number>
inline void add_frame(Rods<Number>& rods, const Ropes& ropes, bool begun, bool rubbed) {
  const bool rubs = strands_turn(rods);
  find_bishop_frame(rods, begun);
  if (rods.locks) find_stiffening(rods);
  if (!rods.twists) {
    turn_freely(rods);
  } else {
    if (!begun) begin_frame(rods, ropes);
    if (!begun && rubs && rubbed) enter_frame(rods);
    if (rubs) find_moments(rods, rubbed, false);
    balance_torques(rods, ropes, true);
  }
  const bool more = rubs || rods.locks;
  if (rods.locks) find_stiffening(rods);
  if (more) find_moments(rods, rubbed, true), add_stiffness(rods);
  const int joints = rods.nodes - 2;
  const double step = rods.step;
  const auto *tangents = rods.tangents.data(), *across = rods.across.data();
  const auto* all_joints = rods.joints.data();
  const auto* natural = rods.natural.data();
  const auto* moments = rods.moments.data();
  const auto* inverse_lengths = rods.inverse_lengths.data();
  auto* impulses = rods.frame_impulses.data();
  impulses[0].x = impulses[0].y = impulses[0].z = Number{};
  Vec3<Number> torque{};  // [N m] on the segment, by the joint before it; turned by a right angle
  const auto add_couple = [&](int i, const Vec3<Number>& whole) {
    impulses[i + 1] = step * inverse_lengths[i] * whole;
    impulses[i] = impulses[i] - impulses[i + 1];
  };
  for (int i = 0; i < joints; ++i) {
    const Vec3<Number>&a = tangents[i], &b = tangents[i + 1], &u = across[i];
    const Joint<Number>& joint = all_joints[i];
    const auto [x, y] = turned(more ? moments[i].x : natural[i].x, more ? moments[i].y : natural[i].y, joint);
    const Number half_x = joint.half * x, half_y = joint.half * y;
    const Vec3<Number> bend = half_x * u + half_y * cross(a, u);
    const Number share = (half_x * joint.x + half_y * joint.y) * (joint.inverse / 2);
    const Number twist = joint.twist * (joint.inverse * joint.inverse / 2);
    const Vec3<Number> turn = twist * cross(a, b);
    add_couple(i, torque - bend - turn);
    torque = bend - share * (a + b) - turn;
  }
  add_couple(joints, torque);
}

}  // namespace DLO_TARGET
}  // namespace dlo
