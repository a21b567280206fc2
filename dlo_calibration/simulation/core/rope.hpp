// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rope: one DLO that is simulated, from its properties to its state.

#pragma once

#include <array>
#include <vector>

#include "rods.hpp"

namespace dlo {

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
/// `thorough`: check every pair of segments, however far apart.
void touch(Rope& rope, bool thorough);

/// The forces [N] of the material frame on the nodes, where the last step was taken from; for tests.
std::vector<Point> frame_forces(Rope& rope);

}  // namespace dlo
