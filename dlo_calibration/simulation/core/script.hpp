// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Script: the events of a trial, independent of the DLO's properties; Outcome: the result of a rollout.

#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <variant>
#include <vector>

#include "rope.hpp"

namespace dlo {

constexpr double kGravity = 9.81;  // m/s^2

/// A hand closes: from now on its nodes keep their offsets from it, which are rows of a table, from `row` on.
struct Close {
  int row;
  std::vector<int> nodes;
  Point position;  // of the hand [m]
};

/// From now on, exactly these nodes are held.
struct Hold {
  std::vector<int> nodes;
};

/// The nodes that a hand holds and its poses while steps are taken; it stays in the last pose.
struct Grip {
  std::vector<int> rows;         // of the table of offsets, one for each node
  std::vector<Point> positions;  // [m] of the hand after each step
  std::vector<Matrix> rotations;  // since it closed, after each step; empty: it does not turn
  std::vector<Matrix> turns;      // in each step
};

/// The DLO is seen within a step: at the share (0 to 1) of the way from its points before the last of `after`
/// steps to its points after it.  If `after` is 0, the way begins at the remembered points.
struct Sight {
  int after;
  double share;
};

/// A move: steps are taken, in which the DLO is seen.
struct Advance {
  std::vector<std::shared_ptr<const Grip>> grips;
  int count = 0;              // of steps; with `settles`, the limit
  bool settles = false;       // the steps end as soon as the DLO is stable
  bool remembers = false;     // the points before the first step are remembered for the next `See`
  std::vector<Sight> sights;  // in order
};

/// The DLO is seen at rest, or at a share of the way from the remembered points.
struct See {
  bool rests;
  double share;
};

struct Event {
  std::variant<Close, Hold, Advance, See> is;
};

/// When a DLO counts as stable: no node moves as far as `distance` [m] within `steps`.
struct Settling {
  double distance;
  int steps;
};

/// Checked events, so that no step needs to check anything.
struct Script {
  std::vector<std::shared_ptr<const Event>> events;
  Settling settling;
  int rows = 0;   // of the table of offsets
  int nodes = 0;  // least number of nodes of a DLO
  bool loads = false;  // they are measured after each step
};

/// A trial to simulate with a parameter set.
struct Job {
  std::shared_ptr<const Script> script;
  std::shared_ptr<const Start> start;
  Properties properties;
  double step;   // [s]
  double level;  // height of nodes that touch the table [m]
  std::shared_ptr<const Scene> scene;  // around it; none: nothing
};

/// The largest value of a load, and where: the index of a node, or the middle between two.
struct Load {
  double value = 0.0, place = 0.0;
};

/// Largest loads in some time; a DLO that is straight, slack and nowhere stretched has none.
struct Loads {
  Load curvature, tension, strain;  // [1/m], [N], -
};

/// The result of a rollout.
struct Outcome {
  std::vector<std::vector<Point>> seen;  // nodes at each goal [m]
  std::vector<std::vector<Point>> forces;  // that hold nodes at each goal [N]; 0 at those that no hand holds
  std::vector<bool> settled;             // for each goal; false: it is a stable one, and the DLO did not rest
  std::vector<Loads> loads;              // for each goal, since the one before; empty if not asked for
  int steps = 0;
  bool diverged = false;
};

/// A kind of processor, and the code compiled for it.
struct Target {
  const char* name;
  std::vector<Outcome> (*roll_out)(const std::vector<Job>& jobs, const std::atomic<bool>& stop);
};

/// The targets whose code this processor can execute, the fastest first.  All give the same bits.
const std::vector<Target>& targets();

/// Follow a script with a rope; `step` takes each step, with the rope's `targets` and `turns`.
Outcome follow(const Script& script, Rope& rope, const std::function<void()>& step);

}  // namespace dlo
