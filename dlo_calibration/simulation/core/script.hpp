// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Script: the events of a trial, which do not depend on the DLO's properties; Outcome: what a rollout gives.

#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <variant>
#include <vector>

#include "rope.hpp"

namespace dlo {

constexpr double kGravity = 9.81;  // m/s^2

/// A hand closes: its nodes keep their offsets from it from now on, as rows of a table, from `row` on.
struct Close {
  int row;
  std::vector<int> nodes;
  Point position;  // of the hand [m]
};

/// From now on, exactly these nodes are held.
struct Hold {
  std::vector<int> nodes;
};

/// Nodes that a hand holds while steps are taken; after the last of these poses, it stays.
struct Grip {
  std::vector<int> rows;         // of the table of offsets, one for each node
  std::vector<Point> positions;  // [m] of the hand after each step
  std::vector<Matrix> rotations;  // since it closed, after each step; or none: it does not turn
  std::vector<Matrix> turns;      // in each step
};

/// The DLO is seen on the way to where it is after some steps, so far (0 to 1) from where it was before the
/// last one of them; before the first step, from where it is remembered.
struct Sight {
  int after;
  double share;
};

/// Steps are taken, and meanwhile the DLO is seen.
struct Advance {
  std::vector<std::shared_ptr<const Grip>> grips;
  int count = 0;              // of steps; with `settles`, the most
  bool settles = false;       // they end as soon as the DLO is stable
  bool remembers = false;     // where the DLO is before is kept for what is seen next
  std::vector<Sight> sights;  // in order
};

/// The DLO is seen at rest, or where `share` says, as in `Sight`.
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

/// Events that have been checked: nothing needs to be checked in a step.
struct Script {
  std::vector<std::shared_ptr<const Event>> events;
  Settling settling;
  int rows = 0;   // of the table of offsets
  int nodes = 0;  // that a DLO must have at least
};

/// A trial to simulate with a parameter set.
struct Job {
  std::shared_ptr<const Script> script;
  std::shared_ptr<const Start> start;
  Properties properties;
  double step;   // [s]
  double level;  // height of nodes that touch the table [m]
};

/// What a rollout gives.
struct Outcome {
  std::vector<std::vector<Point>> seen;  // nodes at each goal [m]
  std::vector<bool> settled;             // false: the goal is a stable configuration, and it was not stable
  int steps = 0;
  bool diverged = false;
};

/// A kind of processor, and the code compiled for it.
struct Target {
  const char* name;
  std::vector<Outcome> (*roll_out)(const std::vector<Job>& jobs, const std::atomic<bool>& stop);
};

/// The kinds of processors whose code this one can execute, the fastest first.  All give the same bits.
const std::vector<Target>& targets();

/// Follow a script with a rope whose steps somebody else takes; `step` reads its `targets` and `turns`.
Outcome follow(const Script& script, Rope& rope, const std::function<void()>& step);

}  // namespace dlo
