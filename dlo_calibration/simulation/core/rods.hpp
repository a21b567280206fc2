// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rods: all that determines the internal forces of one DLO, or of four.

#pragma once

#include <array>
#include <vector>

#include "numbers.hpp"

namespace dlo {

constexpr int kBand = 7;  // entries per column of the lower triangle: node i couples with i + 2

/// A column of the equations' L D L^T: the inverse of D, and below it L D.
template <class Number>
using Column = std::array<Number, kBand>;

/// What holding adds to the equation of a node.
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

}  // namespace dlo
