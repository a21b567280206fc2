// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rollout: follows a script with a rope; `roll_out` takes the steps of four ropes at a time, in SIMD lanes.

#include <algorithm>
#include <memory>
#include <type_traits>

#include "script.hpp"
#include "step.hpp"

namespace dlo {
namespace DLO_TARGET {

constexpr int kChecks = 5;  // of the displacement, within the time in which a DLO must not move

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
      : rope(rope), outcome(outcome), script_(script), offsets_(script.rows), before_(rope.rods.points) {}

  /// Go on to the next steps; tell whether there are any.
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

  /// Tell the rope where its held nodes are after the coming step.
  void aim() {
    std::size_t h = 0;
    for (const auto& grip : move_->grips) {
      const std::size_t k = std::min<std::size_t>(taken_, grip->positions.size() - 1);
      for (int row : grip->rows) {
        const Point& offset = offsets_[row];
        rope.targets[h] =
            grip->positions[k] + (grip->rotations.empty() ? offset : grip->rotations[k] * offset);
        if (!rope.clamps.empty()) rope.turns[h] = grip->turns[k];
        ++h;
      }
    }
  }

  /// Count a step, after which the nodes are at `rods.points`; tell whether the move has ended.
  template <class Number>
  bool arrive(Rods<Number>& rods, int lane) {
    outcome.diverged = in_lane(rods.solved, lane) != 1.0;
    if (outcome.diverged) return true;
    ++taken_, ++outcome.steps;
    const bool last = taken_ == move_->count;
    if (!move_->sights.empty()) {
      copy_out(rods.points, lane, now_);
      see_meanwhile(now_);
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

  /// Begin to take steps, unless none are needed.
  bool begin(const Advance& move) {
    if (move.remembers) before_ = rope.rods.points;
    if (move.settles && rests_) return false;
    move_ = &move;
    taken_ = checks_ = 0, sight_ = 0, rests_ = false;
    until_check_ = period(0);
    if (move.settles) seen_[0] = rope.rods.points;
    rope.turns.resize(rope.clamps.empty() ? 0 : rope.held.size());
    if (!move.sights.empty()) {
      see_meanwhile(rope.rods.points);
      before_ = rope.rods.points;
    }
    return true;
  }

  void see_now(const std::vector<Point>& now, double share, bool rests) {
    outcome.seen.push_back(now);
    if (rests) return;
    auto& seen = outcome.seen.back();
    for (std::size_t i = 0; i < seen.size(); ++i) seen[i] = before_[i] + share * (now[i] - before_[i]);
  }

  void see_meanwhile(const std::vector<Point>& now) {
    for (; sight_ < move_->sights.size() && move_->sights[sight_].after == taken_; ++sight_) {
      see_now(now, move_->sights[sight_].share, false);
      outcome.settled.push_back(true);
    }
  }

  /// Steps between two checks.
  int period(int check) const {
    const int steps = script_.settling.steps, k = check % kChecks;
    return steps * (k + 1) / kChecks - steps * k / kChecks;
  }

  /// Check whether all nodes have stayed where they were.
  template <class Number>
  bool is_stable(std::vector<Vec3<Number>>& points, int lane) {
    until_check_ = period(++checks_);
    copy_out(points, lane, seen_[checks_ % (kChecks + 1)]);
    if (checks_ < kChecks) return false;
    const auto& start = seen_[(checks_ + 1) % (kChecks + 1)];
    double furthest = 0.0;
    for (const auto& later : seen_)
      for (std::size_t i = 0; i < later.size(); ++i) {
        const Point away = later[i] - start[i];
        furthest = max(furthest, dot(away, away));
      }
    return sqrt(furthest) < script_.settling.distance;
  }

  const Script& script_;
  std::size_t event_ = 0;
  std::vector<Point> offsets_;  // of nodes from the hands that hold them
  std::vector<Point> before_;   // where the nodes are remembered
  std::vector<Point> now_;      // workspace
  bool rests_ = false;          // the DLO came to rest, and nothing has happened since
  const Advance* move_ = nullptr;
  int taken_ = 0;  // steps of the move
  std::size_t sight_ = 0;
  int until_check_ = 0, checks_ = 0;
  std::array<std::vector<Point>, kChecks + 1> seen_;  // at the last checks
};

/// A rollout of a rope of its own; its steps are taken together with those of others.
struct LaneRollout {
  LaneRollout(const Job& job, Outcome& outcome)
      : rope(*job.start, job.properties, job.step, {0.0, 0.0, -kGravity}, job.level),
        rollout(*job.script, rope, outcome) {}

  /// Go on to steps that can be taken together with others; tell whether there are any.  The first step of
  /// a rope, which sets up the state of its frame and strands, is taken alone.
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

inline bool contains(const Rollouts& rollouts, const Rollout* one) {
  return std::find(rollouts.begin(), rollouts.end(), one) != rollouts.end();
}

/// Take steps until a move ends; return the rollouts whose move has ended.
template <class Number>
Rollouts advance(Rods<Number>& rods, const Rollouts& rollouts, const std::atomic<bool>& stop) {
  Ropes ropes;
  for (Rollout* one : rollouts) ropes.push_back(&one->rope);
  Rollouts ended;
  while (ended.empty() && !stop.load(std::memory_order_relaxed)) {
    for (Rollout* one : rollouts) one->aim();
    take_step(rods, ropes);
    for (std::size_t lane = 0; lane < rollouts.size(); ++lane)
      if (rollouts[lane]->arrive(rods, static_cast<int>(lane))) ended.push_back(rollouts[lane]);
  }
  return ended;
}

/// DLOs of one kind that are stepped together, each in a lane.
class LaneGroup {
 public:
  /// Let these, of one kind and not more than there are lanes, take steps until a move ends; return the
  /// rollouts whose move has ended.
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
  /// Give exactly these a lane each; those that have one keep it if they can.
  void assign(const Rollouts& rollouts) {
    lanes_.resize(kLanes);
    for (std::size_t lane = 0; lane < lanes_.size(); ++lane)
      if (lanes_[lane] && (lane >= rollouts.size() || !contains(rollouts, lanes_[lane]))) unload(lane);
    lanes_.resize(rollouts.size());
    if (rollouts.empty()) return;
    const Rods<double>& kind = rollouts.front()->rope.rods;
    if (!rods_.is_like(kind)) {
      rods_ = Rods<Lanes>();
      rods_.nodes = kind.nodes, rods_.step = kind.step, rods_.gravity = kind.gravity;
      rods_.framed = kind.framed, rods_.twists = kind.twists, rods_.strands_rub = kind.strands_rub;
      rods_.resize();
    }
    for (Rollout* one : rollouts)
      if (!contains(lanes_, one)) {
        const auto lane = std::find(lanes_.begin(), lanes_.end(), nullptr) - lanes_.begin();
        lanes_[lane] = one;
        load(one->rope.rods, static_cast<int>(lane));
      }
  }

  void load(Rods<double>& one, int lane) {
    in_lane(rods_.drag, lane) = one.drag, in_lane(rods_.implicit, lane) = one.implicit;
    in_lane(rods_.friction, lane) = one.friction, in_lane(rods_.level, lane) = one.level;
    const auto copy = [lane](auto& rows, const auto& from) {
      each_number(rows, from, lane, [](double& a, double b) { a = b; });
    };
    each_property(rods_, one, copy);
    each_state(rods_, one, copy);
  }

  /// Give a rope its state back.
  void unload(std::size_t lane) {
    each_state(rods_, lanes_[lane]->rope.rods, [lane](auto& rows, auto& to) {
      each_number(rows, to, lane, [](double& a, double& b) { b = a; });
    });
    lanes_[lane] = nullptr;
  }

  /// Call `act` for each number of a lane and that of one DLO.
  template <class Rows, class One, class Act>
  static void each_number(Rows& rows, One& one, std::size_t lane, Act act) {
    if (one.empty()) return;
    constexpr std::size_t kNumbers = sizeof(one[0]) / sizeof(double);
    static_assert(sizeof(rows[0]) == kLanes * sizeof(one[0]));
    auto* numbers = reinterpret_cast<double*>(rows.data());
    using Other = std::conditional_t<std::is_const_v<One>, const double, double>;
    auto* others = reinterpret_cast<Other*>(one.data());
    for (std::size_t k = 0; k < kNumbers * one.size(); ++k) act(numbers[kLanes * k + lane], others[k]);
  }

  Rods<Lanes> rods_;
  Rollouts lanes_;
};

/// Choose those that are stepped next: of the most frequent kind, as many as there are lanes.
inline Rollouts chosen(const std::vector<std::unique_ptr<LaneRollout>>& under_way) {
  Rollouts found;
  for (const auto& first : under_way) {
    Rollouts alike;
    for (const auto& one : under_way)
      if (alike.size() < kLanes && one->rollout.rope.rods.is_like(first->rollout.rope.rods))
        alike.push_back(&one->rollout);
    if (alike.size() > found.size()) found = alike;
  }
  return found;
}

inline std::vector<Outcome> roll_out(const std::vector<Job>& jobs, const std::atomic<bool>& stop) {
  std::vector<Outcome> outcomes(jobs.size());
  std::vector<std::unique_ptr<LaneRollout>> under_way;
  LaneGroup group;
  for (std::size_t begun = 0; !stop;) {
    while (begun < jobs.size() && under_way.size() < 2 * kLanes) {
      auto one = std::make_unique<LaneRollout>(jobs[begun], outcomes[begun]);
      ++begun;
      if (one->next()) under_way.push_back(std::move(one));
    }
    if (under_way.empty()) break;
    for (Rollout* one : group.advance(chosen(under_way), stop)) {
      const auto its = std::find_if(under_way.begin(), under_way.end(),
                                    [one](const auto& each) { return &each->rollout == one; });
      if (!(*its)->next()) under_way.erase(its);
    }
  }
  return outcomes;
}

}  // namespace DLO_TARGET
}  // namespace dlo
