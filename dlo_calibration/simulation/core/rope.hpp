// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rope: the properties and the state of one simulated DLO; Rods: what determines the internal forces of one
// DLO, or of four.

#pragma once

#include <array>
#include <memory>
#include <vector>

#include "scene.hpp"
#include "vectors.hpp"

namespace dlo {

constexpr int kBand = 7;  // entries per column of the lower triangle: node i is coupled with node i + 2

/// A column of the factors L D L^T of a step's equations.  Of four DLOs, it is the inverse of D, and below it L D;
/// of one, it is L, in the order of `Elimination`.
template <class Number>
struct alignas(32) Column : std::array<Number, (lanes_of<Number> > 1) ? kBand : kBand + 1> {};

/// What a hand adds to the equation of a node that it holds.
template <class Number>
struct Holding {
  Number weight;         // [kg]
  Vec3<Number> impulse;  // [N s]
};

/// What a segment adds to the equations of a step.
template <class Number>
struct Spring {
  Number across, along;  // stiffness [kg] across the segment, and along it divided by its squared length
  Number impulse;        // [kg/s], to be multiplied by the segment
  Number returned;       // the share of `across` [kg] that is to damp nothing
};

/// Entries of the bending matrix [N/m] at a node: the diagonal, and the two below it.
template <class Number>
using Bending = std::array<Number, 3>;

/// The natural curvature at an inner node times its bending stiffness [N m], and the length of this vector.
template <class Number>
struct Natural {
  Number x, y, size;
};

/// The bend between two segments, in the Bishop frame.
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
  std::array<Number, 3> row;  // [1/m]; its product with three nodes is the bend
  Number stiffness, slip;     // [N m]; the change of the bend at which the strands slip
};

/// The plastic part of the bend at an inner node: the bend at which friction between strands has no stress.
/// Where strands turn with the material frame, `bend` and `strain` are components in it, with z = 0.
template <class Number>
struct PlasticBend {
  Vec3<Number> bend;
  Vec3<Number> tangent;  // mean unit tangent in the last step
  Vec3<Number> strain;   // elastic part of the bend in the last step
};

/// Locking at an inner node, see moments.hpp.
template <class Number>
struct Locking {
  Number stiffness;  // EI / l [N m]
  Number scale;      // how much stiffer a bend of 1 makes the joint
};

/// What friction between strands and locking add to the equation of a node.
template <class Number>
struct StrandForce {
  Bending<Number> matrix;  // [kg]
  Vec3<Number> impulse;    // [N s], against the bend
};

/// Natural curvature, locking and friction between strands at an inner node, in the material frame.
template <class Number>
struct Moment {
  Number x, y;       // what bends the DLO beside its elasticity [N m]
  Number stiffness;  // of the strands [N m]
};

/// One DLO of `nodes` nodes, or four like it.
template <class Number>
struct Rods {
  int nodes = 0;
  bool framed = false;   // it has a material frame: its rest shape is curved, or it resists twist
  bool twists = false;   // it resists twist; else the frame turns freely as a whole
  bool strands_rub = false;
  bool measured = false;  // its tensions are found in each step
  bool locks = false;    // it becomes stiffer where it is bent far
  double step = 0.0;     // [s]
  Point gravity{};       // [m/s^2]

  // Properties.
  Number drag, implicit, surplus;  // [1/s]; c, and what of it is to damp no bending [s^2], see rod.hpp
  Number friction, level;  // of the table; height of nodes that touch it [m]
  std::vector<Number> rest_lengths, stiffness, masses;
  std::vector<Bending<Number>> bending;
  std::vector<Natural<Number>> natural;
  std::vector<Number> twisting;  // torque per angle at inner nodes [N m]
  std::vector<Strands<Number>> strands;
  std::vector<Locking<Number>> locking;

  // State.
  std::vector<Vec3<Number>> points, velocities;  // [m], [m/s]
  std::vector<Vec3<Number>> support;             // change of the velocities by the table in the last step
  std::vector<Number> angles;                    // [rad] of the material frame from the Bishop frame
  std::vector<Vec3<Number>> bishop;  // frame of the first segment: unit tangent, unit vector across
  std::vector<Joint<Number>> joints;
  std::vector<PlasticBend<Number>> plastic;

  // Workspace.
  std::vector<Vec3<Number>> predicted;  // velocities without contact
  std::vector<Spring<Number>> springs;
  std::vector<Column<Number>> columns;  // six of zeros, then those of the matrix
  std::vector<Vec3<Number>> frame_impulses;  // [N s]
  std::vector<Holding<Number>> holding;
  std::vector<char> any_held;  // whether this node is held in any lane
  std::vector<Touching<Number>> touching;
  std::vector<char> any_touching;  // whether `touching` has something at this node in any lane
  std::vector<Vec3<Number>> tangents, across;
  std::vector<Number> inverse_lengths, clamped, prescribed, turning, upper;
  std::vector<StrandForce<Number>> strand_forces;
  std::vector<Moment<Number>> moments;
  std::vector<Number> tensions;            // [N] of the segments, in the last step
  std::vector<Number> stiffening;          // by locking, relative to the bending stiffness
  std::vector<Natural<Number>> stiffened;  // `natural`, as locking changes it
  Number solved;                       // 1 where the last step was finite
  std::array<Number, 2> last_moves{};  // in the last step, see `Movement`
  std::array<Number, 2> next_moves;    // in this step, without contact

  /// Give the arrays their sizes.
  void resize() {
    const std::size_t n = nodes, segments = n - 1, inner = n - 2;
    for (auto* each : {&points, &velocities, &support, &predicted}) each->resize(n);
    for (auto* each : {&rest_lengths, &stiffness}) each->resize(segments);
    masses.resize(n), bending.resize(n), springs.resize(n);
    columns.assign(kBand - 1 + 3 * n, Column<Number>{});
    holding.resize(n), any_held.assign(n, false);
    touching.resize(n), any_touching.assign(n, false);
    for (auto* each : {&angles, &inverse_lengths, &clamped, &prescribed, &turning, &upper})
      each->resize(framed ? segments : 0);
    for (auto* each : {&tangents, &across}) each->resize(framed ? segments : 0);
    frame_impulses.resize(framed ? n : 0);
    natural.resize(framed ? inner : 0), twisting.resize(framed ? inner : 0);
    joints.resize(framed ? inner : 0), bishop.resize(framed ? 2 : 0);
    const bool stiffens = framed && locks, moves = strands_rub || stiffens;
    strands.resize(strands_rub ? inner : 0), plastic.resize(strands_rub ? inner : 0);
    strand_forces.resize(moves ? n : 0), moments.resize(framed && moves ? inner : 0);
    tensions.resize(measured ? segments : 0);
    locking.resize(stiffens ? inner : 0);
    stiffening.resize(stiffens ? inner : 0), stiffened.resize(stiffens ? inner : 0);
  }

  /// Whether it can be stepped together with another DLO.
  template <class Other>
  bool is_like(const Rods<Other>& other) const {
    return nodes == other.nodes && framed == other.framed && twists == other.twists &&
           strands_rub == other.strands_rub && locks == other.locks && measured == other.measured &&
           step == other.step;
  }
};

/// Call `copy(x, y)` for each array x of `a` and y of `b` that belongs to the state.
template <class A, class B, class Copy>
void each_state(A& a, B& b, Copy copy) {
  copy(a.points, b.points), copy(a.velocities, b.velocities), copy(a.support, b.support);
  copy(a.angles, b.angles), copy(a.bishop, b.bishop), copy(a.joints, b.joints), copy(a.plastic, b.plastic);
}

/// Call `copy(x, y)` for each array x of `a` and y of `b` that belongs to the properties.
template <class A, class B, class Copy>
void each_property(A& a, B& b, Copy copy) {
  copy(a.rest_lengths, b.rest_lengths), copy(a.stiffness, b.stiffness), copy(a.masses, b.masses);
  copy(a.bending, b.bending), copy(a.natural, b.natural), copy(a.twisting, b.twisting);
  copy(a.strands, b.strands), copy(a.locking, b.locking);
}

/// Physical properties of a DLO, in SI units; doc/physics.md explains them.
struct Properties {
  double bending_stiffness = 0.0, stretching_stiffness = 0.0, mass = 0.0;
  double drag = 0.0, internal_damping = 0.0, friction = 0.0, radius = 0.0;
  double length_scale = 1.0, natural_curvature = 0.0, marker_mass = 0.0, torsion = 0.0;
  double bending_friction = 0.0, bending_slip = 0.1, locking = 0.0, clamp_twist = 0.0;
  std::vector<double> profile = {1.0};  // bending stiffness of parts of equal length, relative to the first
  std::vector<double> stiffness_knots = {1.0};  // multiply it, at evenly spaced places and linear between them
  std::vector<std::array<double, 2>> rest_curvature;  // [1/m] at evenly spaced places
  std::array<std::array<double, 2>, 2> clamp_bends{};  // [rad] where it leaves a clamp in either half
};

/// Where a DLO is at the start of a trial.
struct Start {
  std::vector<double> places;            // (N) [m] arc lengths of the nodes at rest, from 0
  std::vector<Point> points, velocities;  // (N) [m], [m/s]
  std::vector<double> features;    // (N) number of markers at each node, or empty
  std::vector<Point> directions;   // (N - 1) unit vectors across segments in clamps, else nan; or empty
};

/// Upper bounds [m] of the relative movement of any two nodes, and of two neighbours, in a step.
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
  double normal_impulse;           // so far [N s]
  Point friction_impulse;          // so far [N s]
};

/// Spheres [m], by coordinate.
struct Spheres {
  std::vector<double> x, y, z, radius;
};

/// Contact is between segments: nodes of a thin DLO lie further apart than its diameter, so that spheres at
/// the nodes would let it through.  Two segments cannot touch if their arc-length distance is below half the
/// circumference of the cross-section, the shortest hairpin.  Pairs that are nearer than a diameter at the
/// start keep that distance until they have moved apart: a radius that is too large does not burst the DLO.
struct SelfContact {
  double diameter = 0.0, friction = 0.0;
  double least_arc = 0.0;              // least arc length [m] between two segments that can touch
  int next_segment = 0;                // least difference of the indices of two segments that can touch
  std::vector<double> half, middles;   // [m] of segments: half lengths, arc lengths of the middles
  std::vector<double> distances;       // [m] (S, S), row by row: least distances of pairs
  bool overlaps = false;               // some of them may be below the diameter
  std::vector<std::array<int, 2>> near;  // neighbour list: pairs whose gap is within the Verlet skin
  // Room [m] for relative movement: of neighbours, until segments that are near along the DLO can touch; of
  // any nodes, until others can touch, and until `near` is out of date.
  double room_beside = -1.0, room_away = -1.0, room_near = -1.0;
  std::vector<Contact> contacts;  // workspace, as are the following
  std::vector<Point> change;
  Spheres single, twin;
};

/// A segment that a clamp keeps from turning about its axis.
struct Clamp {
  int segment, held;  // `held`: index in `Rope::held` of the node whose hand turns it
  Point direction;    // unit vector of the material frame; nan: unknown
  Point tangent;      // of the segment in the last step; nan: unknown
};

class Rope {
 public:
  Rope(const Start& start, const Properties& properties, double step, Point gravity, double level,
       std::shared_ptr<const Scene> scene);

  /// Hold exactly these nodes from now on: they go to `targets`.  A segment between two of them is rigid, so
  /// that bending begins where a clamped DLO leaves its clamp.
  void hold(const std::vector<int>& nodes);

  /// Whether its first step has been taken, which initialises the state of frame and strands.
  bool has_begun() const { return (!rods.framed || frame_begun) && (!rods.strands_rub || strands_begun); }

  Rods<double> rods;
  SelfContact contact;
  SceneContact surroundings;
  std::vector<int> held;
  std::vector<Point> targets, hand_velocities;  // of held nodes: after the coming step [m]; in it [m/s]
  std::vector<Point> hand_forces;      // that hold them [N], smoothed
  std::vector<Matrix> turns;           // of their hands in the coming step; empty: clamps turn with segments
  std::vector<Clamp> clamps;
  std::vector<double> inverse_masses;  // 0 for held nodes
  bool frame_begun = false, strands_begun = false;
  bool follows = false;  // it follows a script; then only the script holds and aims it

 private:
  void hold_frame(const std::vector<bool>& rigid, const std::vector<double>& stiffnesses,
                  const std::vector<double>& cells);
  std::vector<double> stiffnesses(const std::vector<bool>& rigid) const;

  Properties properties_;
  std::vector<Point> directions_;  // of the rest shape in clamps at the start
  double length_ = 0.0;            // at rest [m]
};

using Ropes = std::vector<Rope*>;  // stepped together, one in each lane

/// Compute the velocities `predicted` without contact with other bodies; return whether they are finite.
bool predict(Rope& rope);

/// Take a step on a table; return whether the rope is still finite.
bool take_step(Rope& rope);

/// The signed distance [m] of a point from the surface of a body.
double distance(const Body& body, const Point& at);

}  // namespace dlo
