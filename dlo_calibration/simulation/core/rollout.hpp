// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rollout: a rope that follows a script; `roll_out` takes the steps of four ropes at a time, in SIMD lanes.

#include <algorithm>
#include <memory>
#include <type_traits>

#include "script.hpp"
#include "step.hpp"
#include "loads.hpp"

namespace dlo {
namespace DLO_TARGET {

constexpr int kChecks = 5;  // checks of the displacement within the time in which a stable DLO does not move

/// Copy the rows of one lane.
template <class Number>
void copy_out(std::vector<Vec3<Number>>& rows, int lane, std::vector<Point>& to) {
  to.resize(rows.size());
  for (std::size_t i = 0; i < to.size(); ++i) to[i] = in_lane(rows[i], lane);
}

/// A rope that follows a script.
class Rollout {
 public:
  Rollout(const Script& script, Rope& rope, Outcome& outcome)
      : rope(rope), outcome(outcome), script_(script), offsets_(script.rows), before_(rope.rods.points) {
    rope.rods.measured = script.loads;
    rope.rods.resize();
  }

  /// Go on to the next move; return whether there is one.
  bool next() {
    while (!outcome.diverged && event_ < script_.events.size()) {
      const Event& event = *script_.events[event_++];
      if (const auto* close = std::get_if<Close>(&event.is)) act(*close);
      else if (const auto* hold = std::get_if<Hold>(&event.is)) act(*hold);
      else if (const auto* see = std::get_if<See>(&event.is)) act(*see);
      else if (begin(std::get<Advance>(event.is))) return true;
    }
    return false;
  }

  /// Give the rope the targets of its held nodes in the coming step.
  void aim() {
    std::size_t h = 0;
    for (const auto& grip : move_->grips) {
      const std::size_t k = std::min<std::size_t>(steps_, grip->positions.size() - 1);
      for (int row : grip->rows) {
        const Point& offset = offsets_[row];
        rope.targets[h] =
            grip->positions[k] + (grip->rotations.empty() ? offset : grip->rotations[k] * offset);
        if (!rope.clamps.empty()) rope.turns[h] = grip->turns[k];
        ++h;
      }
    }
  }

  /// Count a step that ended at `rods.points`; return whether the move has ended.
  template <class Number>
  bool arrive(Rods<Number>& rods, int lane) {
    outcome.diverged = in_lane(rods.solved, lane) != 1.0;
    if (outcome.diverged) return true;
    ++steps_, ++outcome.steps;
    if (script_.loads) meter_.measure(rods, lane, rope);
    const bool last = steps_ == move_->count;
    if (!move_->sights.empty()) {
      copy_out(rods.points, lane, now_);
      see_in_motion(now_);
      if (!last) before_.swap(now_);
    }
    if (move_->settles && (--until_check_ == 0 || last)) rests_ = is_stable(rods.points, lane);
    return last || rests_;
  }

  Rope& rope;
  Outcome& outcome;

 private:
  void act(const Hold& hold) {
    rope.hold(hold.nodes);
    rests_ = false;
  }

  void act(const Close& close) {
    for (std::size_t k = 0; k < close.nodes.size(); ++k)
      offsets_[close.row + k] = rope.rods.points[close.nodes[k]] - close.position;
  }

  void act(const See& see) {
    see_now(rope.rods.points, see.share, see.rests);
    outcome.settled.push_back(rests_ || !see.rests);
  }

  /// Begin a move, unless the DLO need not settle again.
  bool begin(const Advance& move) {
    if (move.remembers) before_ = rope.rods.points;
    if (move.settles && rests_) return false;
    move_ = &move;
    steps_ = checks_ = 0, sight_ = 0, rests_ = false;
    until_check_ = period(0);
    if (move.settles) checked_[0] = rope.rods.points;
    rope.turns.resize(rope.clamps.empty() ? 0 : rope.held.size());
    if (!move.sights.empty()) {
      see_in_motion(rope.rods.points);
      before_ = rope.rods.points;
    }
    return true;
  }

  void see_now(const std::vector<Point>& now, double share, bool rests) {
    outcome.seen.push_back(now);
    outcome.forces.emplace_back(now.size(), Point{0.0, 0.0, 0.0});
    for (std::size_t h = 0; h < rope.held.size(); ++h) outcome.forces.back()[rope.held[h]] = rope.hand_forces[h];
    if (script_.loads) outcome.loads.push_back(meter_.take());
    if (rests) return;
    auto& seen = outcome.seen.back();
    for (std::size_t i = 0; i < seen.size(); ++i) seen[i] = before_[i] + share * (now[i] - before_[i]);
  }

  void see_in_motion(const std::vector<Point>& now) {
    for (; sight_ < move_->sights.size() && move_->sights[sight_].after == steps_; ++sight_) {
      see_now(now, move_->sights[sight_].share, false);
      outcome.settled.push_back(true);
    }
  }

  /// Number of steps from a check to the next.
  int period(int check) const {
    const int steps = script_.settling.steps, k = check % kChecks;
    return steps * (k + 1) / kChecks - steps * k / kChecks;
  }

  /// Return whether no node has moved by the distance of `Settling` within its steps.
  template <class Number>
  bool is_stable(std::vector<Vec3<Number>>& points, int lane) {
    until_check_ = period(++checks_);
    copy_out(points, lane, checked_[checks_ % (kChecks + 1)]);
    if (checks_ < kChecks) return false;
    const auto& start = checked_[(checks_ + 1) % (kChecks + 1)];
    double furthest = 0.0;
    for (const auto& later : checked_)
      for (std::size_t i = 0; i < later.size(); ++i) {
        const Point away = later[i] - start[i];
        furthest = max(furthest, dot(away, away));
      }
    return sqrt(furthest) < script_.settling.distance;
  }

  const Script& script_;
  std::size_t event_ = 0;
  std::vector<Point> offsets_;  // of nodes from the hands that hold them
  std::vector<Point> before_;   // remembered points, where the next sight begins
  std::vector<Point> now_;      // workspace
  LoadMeter meter_;
  bool rests_ = false;          // the DLO has come to rest since the last event
  const Advance* move_ = nullptr;
  int steps_ = 0;  // of the move, so far
  std::size_t sight_ = 0;
  int until_check_ = 0, checks_ = 0;
  std::array<std::vector<Point>, kChecks + 1> checked_;  // points at the last checks
};

/// A rollout with its own rope; its steps are taken together with those of others.
struct LaneRollout {
  LaneRollout(const Job& job, Outcome& outcome)
      : rope(*job.start, job.properties, job.step, {0.0, 0.0, -kGravity}, job.level, job.scene),
        rollout(*job.script, rope, outcome) {}

  /// Go on to steps that can be taken together with others; return whether there are any.  The first step of
  /// a rope, which initialises the state of its frame and strands, is taken alone.
  bool next() {
    while (rollout.next()) {
      if (rope.has_begun()) return true;
      rollout.aim();
      take_step(rope.rods, {&rope});
      if (!rollout.arrive(rope.rods, 0)) return true;
    }
    return false;
  }

  Rope rope;
  Rollout rollout;
};

using Rollouts = std::vector<Rollout*>;

inline bool contains(const Rollouts& rollouts, const Rollout* rollout) {
  return std::find(rollouts.begin(), rollouts.end(), rollout) != rollouts.end();
}

/// Take steps until a move ends or `stop` is set; return the rollouts whose move has ended.
template <class Number>
Rollouts advance(Rods<Number>& rods, const Rollouts& rollouts, const std::atomic<bool>& stop) {
  Ropes ropes;
  for (Rollout* rollout : rollouts) ropes.push_back(&rollout->rope);
  Rollouts ended;
  while (ended.empty() && !stop.load(std::memory_order_relaxed)) {
    for (Rollout* rollout : rollouts) rollout->aim();
    take_step(rods, ropes);
    for (std::size_t lane = 0; lane < rollouts.size(); ++lane)
      if (rollouts[lane]->arrive(rods, static_cast<int>(lane))) ended.push_back(rollouts[lane]);
  }
  return ended;
}

/// DLOs that are alike and are stepped together, each in a lane.
class LaneGroup {
 public:
  /// Take steps of rollouts that are alike, at most one per lane, until a move ends or `stop` is set; return
  /// the rollouts whose move has ended.
  Rollouts advance(const Rollouts& rollouts, const std::atomic<bool>& stop) {
    if (rollouts.size() == 1) {
      assign({});
      return DLO_TARGET::advance(rollouts.front()->rope.rods, rollouts, stop);
    }
    assign(rollouts);
    const Rollouts ended = DLO_TARGET::advance(rods_, lanes_, stop);
    for (std::size_t lane = 0; lane < lanes_.size(); ++lane)
      if (contains(ended, lanes_[lane])) unload(lane);
    return ended;
  }

 private:
  /// Give each of these rollouts a lane, and no others; a rollout that has a lane keeps it if it can.
  void assign(const Rollouts& rollouts) {
    lanes_.resize(kLanes);
    for (std::size_t lane = 0; lane < lanes_.size(); ++lane)
      if (lanes_[lane] && (lane >= rollouts.size() || !contains(rollouts, lanes_[lane]))) unload(lane);
    lanes_.resize(rollouts.size());
    if (rollouts.empty()) return;
    const Rods<double>& first = rollouts.front()->rope.rods;
    if (!rods_.is_like(first)) {
      rods_ = Rods<Lanes>();
      rods_.nodes = first.nodes, rods_.step = first.step, rods_.gravity = first.gravity;
      rods_.framed = first.framed, rods_.twists = first.twists;
      rods_.strands_rub = first.strands_rub, rods_.locks = first.locks;
      rods_.measured = first.measured;
      rods_.resize();
    }
    for (Rollout* rollout : rollouts)
      if (!contains(lanes_, rollout)) {
        const auto lane = std::find(lanes_.begin(), lanes_.end(), nullptr) - lanes_.begin();
        lanes_[lane] = rollout;
        load(rollout->rope.rods, static_cast<int>(lane));
      }
  }

  void load(Rods<double>& rods, int lane) {
    in_lane(rods_.drag, lane) = rods.drag;
    in_lane(rods_.implicit, lane) = rods.implicit, in_lane(rods_.surplus, lane) = rods.surplus;
    in_lane(rods_.friction, lane) = rods.friction, in_lane(rods_.level, lane) = rods.level;
    const auto copy = [lane](auto& rows, const auto& from) {
      each_number(rows, from, lane, [](double& a, double b) { a = b; });
    };
    each_property(rods_, rods, copy);
    each_state(rods_, rods, copy);
  }

  /// Copy the state of a lane back to its rope.
  void unload(std::size_t lane) {
    each_state(rods_, lanes_[lane]->rope.rods, [lane](auto& rows, auto& to) {
      each_number(rows, to, lane, [](double& a, double& b) { b = a; });
    });
    lanes_[lane] = nullptr;
  }

  /// Call `act` for each number of a lane and that of one DLO.
  template <class Rows, class Single, class Act>
  static void each_number(Rows& rows, Single& single, std::size_t lane, Act act) {
    if (single.empty()) return;
    constexpr std::size_t kNumbers = sizeof(single[0]) / sizeof(double);
    static_assert(sizeof(rows[0]) == kLanes * sizeof(single[0]));
    auto* numbers = reinterpret_cast<double*>(rows.data());
    using Other = std::conditional_t<std::is_const_v<Single>, const double, double>;
    auto* others = reinterpret_cast<Other*>(single.data());
    for (std::size_t k = 0; k < kNumbers * single.size(); ++k) act(numbers[kLanes * k + lane], others[k]);
  }

  Rods<Lanes> rods_;
  Rollouts lanes_;
};

/// The rollouts that are stepped next: as many that are alike as possible, at most one per lane.
inline Rollouts largest_group(const std::vector<std::unique_ptr<LaneRollout>>& under_way) {
  Rollouts largest;
  for (const auto& first : under_way) {
    Rollouts alike;
    for (const auto& other : under_way)
      if (alike.size() < kLanes && other->rollout.rope.rods.is_like(first->rollout.rope.rods))
        alike.push_back(&other->rollout);
    if (alike.size() > largest.size()) largest = alike;
  }
  return largest;
}

inline std::vector<Outcome> roll_out(const std::vector<Job>& jobs, const std::atomic<bool>& stop) {
  std::vector<Outcome> outcomes(jobs.size());
  std::vector<std::unique_ptr<LaneRollout>> under_way;
  LaneGroup group;
  for (std::size_t begun = 0; !stop;) {
    while (begun < jobs.size() && under_way.size() < 2 * kLanes) {
      auto rollout = std::make_unique<LaneRollout>(jobs[begun], outcomes[begun]);
      ++begun;
      if (rollout->next()) under_way.push_back(std::move(rollout));
    }
    if (under_way.empty()) break;
    for (Rollout* ended : group.advance(largest_group(under_way), stop)) {
      const auto owner = std::find_if(under_way.begin(), under_way.end(),
                                      [ended](const auto& each) { return &each->rollout == ended; });
      if (!(*owner)->next()) under_way.erase(owner);
    }
  }
  return outcomes;
}

}  // namespace DLO_TARGET
}  // namespace dlo
