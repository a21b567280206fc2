// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Scene: fixed bodies that the DLO touches, and what a DLO keeps about its contact with them.

#pragma once

#include <array>
#include <memory>
#include <vector>

#include "vectors.hpp"

namespace dlo {

/// Signed distances [m] from a surface at the points of a grid, z fastest; several bodies may share it.
struct Grid {
  Point corner;               // first point [m], in the frame of the body
  double cell;                // [m]
  std::array<int, 3> counts;  // of points
  std::vector<float> distances;
};

enum class Shape { kSphere, kBox, kCylinder, kCapsule, kGrid };

/// A body that does not move.
struct Body {
  Shape shape;
  std::array<double, 3> sizes;  // [m] radius; half edges; or half length and radius along z
  Point position;               // [m] of its frame
  Matrix turn;                  // from its frame to that of the world
  double friction;
  double reach;                 // [m] from `position` to the point furthest away
  std::shared_ptr<const Grid> grid;
};

struct Scene {
  std::vector<Body> bodies;
};

/// A place of the DLO that touches a body, or may do so in this step: a node, or a point between two.
struct Touch {
  int body, node;
  bool between;                 // it lies between this node and the next
  std::array<double, 2> weights;  // of these two nodes
  Point normal;                 // from the body to the DLO
  double mobility;              // velocity per impulse [1/kg]
  double least;                 // least velocity along the normal [m/s]
  bool pushes = false;          // the body pushes the DLO
  double push = 0.0;            // impulse along the normal [N s]
  double drag = 0.0;            // friction: impulse against the sliding, per velocity [kg]
  Point impulse{};              // all of it in the last solution [N s]
};

/// A body and a segment whose gap is within the Verlet skin.
struct Near {
  int body, segment;
  double room;  // [m] that `SceneContact::moved` may become until they can touch
};

/// Contact is that of the capsules around the segments, so that nothing passes between two nodes.  What lies
/// in a body at the start may stay there until it has left: a radius that is too large throws nothing away.
struct SceneContact {
  std::shared_ptr<const Scene> scene;
  double radius = 0.0, friction = 0.0;
  std::vector<double> allowed;             // [m] least gap, for each body at each node and between two nodes
  std::vector<Near> near;                  // sorted
  double moved = 0.0;                      // [m] that any node may have moved since `near` was found
  double room = -1.0;                      // [m] that `moved` may become until `near` is out of date
  double least_room = 0.0;                 // [m] of `near`
  std::vector<Touch> touches, former;      // sorted by body, node and `between`
};

/// What bodies add to the equations of a node and the next one: a symmetric matrix each, xx xy xz yy yz zz.
template <class Number>
struct Touching {
  std::array<Number, 6> own, next;  // [kg]
  Vec3<Number> impulse;             // [N s]
};

}  // namespace dlo
