// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rope: one DLO that is simulated, from its properties to its state; Rods: all that determines the internal
// forces of one DLO, or of four.

#pragma once

#include <array>
#include <vector>

namespace dlo {

// Numbers of a simulation: a number is a double, or the doubles of four DLOs in SIMD lanes (`Lanes`).

constexpr int kLanes = 4;  // DLOs that are stepped together

/// How many DLOs a number belongs to.
template <class Number>
constexpr int lanes_of = sizeof(Number) / sizeof(double);

/// The number in one lane.
template <class Number>
inline double& in_lane(Number& number, int k) {
  return reinterpret_cast<double*>(&number)[k];
}

template <class Number>
struct Vec3 {
  Number x, y, z;
};

using Point = Vec3<double>;
using Matrix = std::array<double, 9>;  // row by row

template <class Number>
inline Point in_lane(Vec3<Number>& v, int k) {
  return {in_lane(v.x, k), in_lane(v.y, k), in_lane(v.z, k)};
}

template <class Number>
inline void set_lane(Vec3<Number>& v, int k, const Point& to) {
  in_lane(v.x, k) = to.x, in_lane(v.y, k) = to.y, in_lane(v.z, k) = to.z;
}

constexpr int kBand = 7;  // entries per column of the lower triangle: node i couples with i + 2

/// A column of the equations' L D L^T: the inverse of D, and below it L D.
template <class Number>
using Column = std::array<Number, kBand>;

/// What a hand adds to the equation of a node that it holds.
template <class Number>
struct Holding {
  Number weight;         // [kg]
  Vec3<Number> impulse;  // [N s]
};

/// A segment's share in the equations of a step.
template <class Number>
struct Spring {
  Number across, along;  // stiffness [kg] across the segment, and along it divided by its squared length
  Number impulse;        // [kg/s], to be multiplied by the segment
};

/// Of the bending matrix [N/m] at a node: the diagonal, and the entries one and two below.
template <class Number>
using Bending = std::array<Number, 3>;

/// Natural curvature at an inner node, times its bending stiffness [N m], and the length of that vector.
template <class Number>
struct Natural {
  Number x, y, size;
};

/// The bend between two segments, in the frame that is carried along the DLO without twist.
template <class Number>
struct Joint {
  Number x, y;           // components of the bend
  Number inverse, half;  // inverse cosine of half the angle between the segments, and the cosine
  Number cosine, sine;   // of the mean angle of the material frame
  Number twist;          // moment [N m]
};

/// Friction between strands at an inner node.
template <class Number>
struct Strands {
  std::array<Number, 3> row;  // [1/m]; multiplied by three nodes, it gives the bend
  Number stiffness, slip;     // [N m]; the change of the bend at which the strands slip
};

/// The plastic part of the bend at an inner node, in which friction between strands is free of stress.
template <class Number>
struct PlasticBend {
  Vec3<Number> bend;
  Vec3<Number> tangent;  // mean unit tangent in the last step
  Vec3<Number> strain;   // elastic part of the bend in the last step
};

/// What friction between strands adds to the equation of a node.
template <class Number>
struct StrandForce {
  Bending<Number> matrix;  // [kg]
  Vec3<Number> impulse;    // [N s], against the bend
};

/// One DLO of `nodes` nodes, or four of the same kind.
template <class Number>
struct Rods {
  int nodes = 0;
  bool framed = false;   // there is a material frame: the rest shape is curved, or the DLO resists twist
  bool twists = false;   // it resists twist; else the frame turns freely as a whole
  bool strands_rub = false;
  double step = 0.0;     // [s]
  Point gravity{};       // [m/s^2]

  // Properties.
  Number drag, implicit;   // [1/s]; c [s^2] of the time step, see rod.hpp
  Number friction, level;  // of the table; height of nodes that touch it [m]
  std::vector<Number> rest_lengths, stiffness, masses;
  std::vector<Bending<Number>> bending;
  std::vector<Natural<Number>> natural;
  std::vector<Number> twisting;  // torque per angle at inner nodes [N m]
  std::vector<Strands<Number>> strands;

  // State.
  std::vector<Vec3<Number>> points, velocities;  // [m], [m/s]
  std::vector<Vec3<Number>> support;             // change of the velocities by the table in the last step
  std::vector<Number> angles;                    // [rad] of the material frame from the carried one
  std::vector<Vec3<Number>> carried;  // of the first segment: unit tangent, unit vector across
  std::vector<Joint<Number>> joints;
  std::vector<PlasticBend<Number>> plastic;

  // Workspace.
  std::vector<Vec3<Number>> predicted;  // velocities without contact
  std::vector<Spring<Number>> springs;
  std::vector<Column<Number>> columns;  // six of zeros, then those of the matrix
  std::vector<Vec3<Number>> frame_impulses;  // [N s]
  std::vector<Holding<Number>> holding;
  std::vector<char> any_held;  // whether a DLO has this node held
  std::vector<Vec3<Number>> tangents, across;
  std::vector<Number> inverse_lengths, clamped, given, turning, upper;
  std::vector<StrandForce<Number>> strand_forces;
  Number solved;                     // 1 where the last step was finite
  std::array<Number, 2> last_moves{};  // see `Movement`: in the last step
  std::array<Number, 2> next_moves;  // and in this one, without contact

  /// Give the arrays their sizes.
  void resize() {
    const std::size_t n = nodes, segments = n - 1, inner = n - 2;
    for (auto* each : {&points, &velocities, &support, &predicted}) each->resize(n);
    for (auto* each : {&rest_lengths, &stiffness}) each->resize(segments);
    masses.resize(n), bending.resize(n), springs.resize(n);
    columns.assign(kBand - 1 + 3 * n, Column<Number>{});
    holding.resize(n), any_held.assign(n, false);
    for (auto* each : {&angles, &inverse_lengths, &clamped, &given, &turning, &upper})
      each->resize(framed ? segments : 0);
    for (auto* each : {&tangents, &across}) each->resize(framed ? segments : 0);
    frame_impulses.resize(framed ? n : 0);
    natural.resize(framed ? inner : 0), twisting.resize(framed ? inner : 0);
    joints.resize(framed ? inner : 0), carried.resize(framed ? 2 : 0);
    strands.resize(strands_rub ? inner : 0), plastic.resize(strands_rub ? inner : 0);
    strand_forces.resize(strands_rub ? n : 0);
  }

  /// Whether it can be stepped together with another one.
  template <class Other>
  bool is_like(const Rods<Other>& other) const {
    return nodes == other.nodes && framed == other.framed && twists == other.twists &&
           strands_rub == other.strands_rub && step == other.step;
  }
};

/// Call `copy(x, y)` for each array x of `a` and y of `b` that belongs to the state.
template <class A, class B, class Copy>
void each_state(A& a, B& b, Copy copy) {
  copy(a.points, b.points), copy(a.velocities, b.velocities), copy(a.support, b.support);
  copy(a.angles, b.angles), copy(a.carried, b.carried), copy(a.joints, b.joints), copy(a.plastic, b.plastic);
}

/// Call `copy(x, y)` for each array x of `a` and y of `b` that belongs to the properties.
template <class A, class B, class Copy>
void each_property(A& a, B& b, Copy copy) {
  copy(a.rest_lengths, b.rest_lengths), copy(a.stiffness, b.stiffness), copy(a.masses, b.masses);
  copy(a.bending, b.bending), copy(a.natural, b.natural), copy(a.twisting, b.twisting);
  copy(a.strands, b.strands);
}

/// Physical properties of a DLO, in SI units; doc/physics.md explains them.
struct Properties {
  double bending_stiffness = 0.0, stretching_stiffness = 0.0, mass = 0.0;
  double drag = 0.0, internal_damping = 0.0, friction = 0.0, radius = 0.0;
  double length_scale = 1.0, natural_curvature = 0.0, marker_mass = 0.0, torsion = 0.0;
  double bending_friction = 0.0, bending_slip = 0.1, clamp_twist = 0.0;
  std::vector<double> profile = {1.0};  // bending stiffness of parts of equal length, relative to the first
  std::vector<std::array<double, 2>> rest_curvature;  // [1/m] at places that divide the length evenly
};

/// Where a DLO is at the start of a trial.
struct Start {
  std::vector<double> places;            // (N) [m] arc lengths of the nodes at rest, from 0
  std::vector<Point> points, velocities;  // (N) [m], [m/s]
  std::vector<double> features;          // (N) number of markers at each node, or none
  std::vector<Point> directions;        // (N - 1) across segments in clamps; nan where there is none; or none
};

/// Upper bounds [m] of how any two nodes, and any two neighbours, move against each other in a step.
struct Movement {
  double any, neighbours;
};

/// Two segments that touch each other.
struct Contact {
  std::array<int, 4> nodes;        // ends of the first and of the second segment
  std::array<double, 4> weights;   // of the nodes in the relative velocity of the closest points
  std::array<double, 4> yielding;  // inverse masses [1/kg]; 0 if another body supports the node
  Point normal;                    // from the second to the first segment
  double mobility;                 // relative velocity per impulse [1/kg]
  double least;                    // least velocity along the normal [m/s]
  double pushed;                   // total impulse along the normal [N s]
  Point rubbed;                    // total impulse across it
};

/// Spheres [m], each array one coordinate.
struct Spheres {
  std::vector<double> x, y, z, radius;
};

/// Spheres at the nodes would let parts of a thin DLO through, because its nodes lie further apart than its
/// diameter.  Two segments whose arc-length distance is below half the circumference of the cross-section
/// cannot touch: that is the shortest hairpin.  Pairs that are nearer than a diameter at the start keep that
/// distance until they have moved apart, so that a radius that is too large does not burst the DLO open.
struct SelfContact {
  double diameter = 0.0, friction = 0.0;
  double apart = 0.0;                  // least arc length [m] between two segments that can touch
  int next_one = 0;                    // how many segments further the first one is that a segment can touch
  std::vector<double> half, middles;   // [m] of segments: half their lengths, arc lengths of their middles
  std::vector<double> distances;       // [m] (S, S), row by row: least distances of pairs
  bool overlaps = false;               // some of them may be below the diameter
  std::vector<std::array<int, 2>> near;  // pairs that are near each other
  // How far [m] neighbours may still move against each other until segments that are near along the DLO can
  // touch; how far any nodes may until others can; and until `near` must be found anew.
  double room_beside = -1.0, room_away = -1.0, room_near = -1.0;
  std::vector<Contact> contacts;  // workspace, like the following
  std::vector<Point> change;
  Spheres single, twin;
};

/// A segment that a clamp keeps from turning about its axis.
struct Clamp {
  int segment, held;  // the latter: which of the held nodes tells how it turns
  Point direction;    // unit vector of the material frame; nan: unknown
  Point tangent;      // of the segment in the last step; nan: unknown
};

class Rope {
 public:
  Rope(const Start& start, const Properties& properties, double step, Point gravity, double level);

  /// Let exactly these nodes follow given positions from now on.  A segment between two of them is rigid, so
  /// that bending begins at its end, where a clamped DLO leaves its clamp.
  void hold(const std::vector<int>& nodes);

  /// Whether its first step, which sets up the state of frame and friction, has been taken.
  bool has_begun() const { return (!rods.framed || frame_begun) && (!rods.strands_rub || strands_begun); }

  Rods<double> rods;
  SelfContact contact;
  std::vector<int> held;
  std::vector<Point> targets, hand_velocities;  // of held nodes in the coming step: where to [m]; [m/s]
  std::vector<Matrix> turns;           // how their hands turn in that step; empty: with the segment
  std::vector<Clamp> clamps;
  std::vector<double> inverse_masses;  // 0 for held nodes
  bool frame_begun = false, strands_begun = false;
  bool follows = false;  // a script, which alone holds and aims it

 private:
  void hold_frame(const std::vector<bool>& rigid, const std::vector<double>& stiffnesses,
                  const std::vector<double>& cells);
  std::vector<double> stiffnesses(const std::vector<bool>& rigid) const;

  Properties properties_;
  std::vector<Point> directions_;  // of the rest shape in clamps at the start
  double length_ = 0.0;            // at rest [m]
};

using Ropes = std::vector<Rope*>;  // those that are stepped together, one in each lane

/// Find the velocities of a rope without contact with others, with its `targets` and `turns`; tell whether
/// they are finite.
bool predict(Rope& rope);

/// Take a step on a table; tell whether the rope is still finite.
bool take_step(Rope& rope);

/// Let self-contact change `predicted` as in a step, for tests.
void touch(Rope& rope);

}  // namespace dlo
