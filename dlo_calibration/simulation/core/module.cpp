// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Module: what Python sees.  All input is checked here, so that no step needs to.

#include <pybind11/functional.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "script.hpp"

namespace py = pybind11;
using namespace py::literals;

namespace dlo {
namespace {

using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;
constexpr std::size_t kMostNodes = 10000;  // the table of distances of segments grows with their square
constexpr int kFewestStableSteps = 5, kMostStableSteps = 100000000;  // so many checks are made within them

void require(bool holds, const std::string& what) {
  if (!holds) throw py::value_error(what);
}

void require_finite(const char* name, double number) {
  require(std::isfinite(number), std::string(name) + ": got a number that is not finite");
}

bool all_finite(const Array& array) {
  return std::all_of(array.data(), array.data() + array.size(), [](double x) { return std::isfinite(x); });
}

/// Rows of a kind that consists of numbers, from an array (n, ...) with as many numbers in each row.
template <class Row>
std::vector<Row> rows(const char* name, const Array& array, bool finite = true) {
  constexpr py::ssize_t kNumbers = sizeof(Row) / sizeof(double);
  const py::ssize_t n = array.ndim() ? array.shape(0) : 0;
  require(array.size() == n * kNumbers, std::string(name) + ": got " + std::to_string(array.size()) +
                                            " numbers, expected rows of " + std::to_string(kNumbers));
  require(!finite || all_finite(array), std::string(name) + ": got a number that is not finite");
  std::vector<Row> found(n);
  std::copy_n(array.data(), array.size(), reinterpret_cast<double*>(found.data()));
  return found;
}

template <class Row>
std::vector<Row> rows(const char* name, const std::optional<Array>& array, bool finite = true) {
  return array ? rows<Row>(name, *array, finite) : std::vector<Row>{};
}

Point point(const char* name, const Array& array) {
  require(array.size() == 3, std::string(name) + ": got an array of another size than 3");
  for (int c = 0; c < 3; ++c) require_finite(name, array.data()[c]);
  return {array.data()[0], array.data()[1], array.data()[2]};
}

/// Rows as an array (n, ...) of their numbers, which shares their memory with `owner`; without one, a copy.
template <class Row>
Array array_of(const std::vector<Row>& rows, const py::object& owner = {}) {
  constexpr py::ssize_t kNumbers = sizeof(Row) / sizeof(double);
  std::vector<py::ssize_t> shape = {static_cast<py::ssize_t>(rows.size())};
  if (kNumbers > 1) shape.push_back(kNumbers);
  return Array(shape, reinterpret_cast<const double*>(rows.data()), owner);
}

Properties properties_of(const py::object& mapping) {
  py::dict physical;
  try {
    physical = py::dict(mapping);
  } catch (const py::error_already_set&) {
    throw py::type_error("physical: got no mapping");
  }
  const auto get = [&](const std::string& name, double otherwise) {
    try {
      return physical.contains(name) ? physical[name.c_str()].cast<double>() : otherwise;
    } catch (const py::cast_error&) {
      throw py::type_error(name + ": got no number");
    }
  };
  const auto need = [&](const std::string& name) {
    if (!physical.contains(name)) throw py::key_error(name);
    return get(name, 0.0);
  };
  Properties found;
  found.bending_stiffness = need("flexibility"), found.stretching_stiffness = need("elasticity");
  found.mass = need("mass"), found.drag = need("damping");
  found.internal_damping = need("internal_damping"), found.friction = need("friction");
  found.radius = need("self_collision"), found.length_scale = get("length_scale", 1.0);
  found.natural_curvature = get("natural_curvature", 0.0), found.marker_mass = get("marker_mass", 0.0);
  found.torsion = get("torsion", 0.0), found.bending_friction = get("bending_friction", 0.0);
  found.bending_slip = get("bending_slip", 0.1), found.clamp_twist = get("clamp_twist", 0.0);
  for (int part = 2; physical.contains("stiffness_" + std::to_string(part)); ++part)
    found.profile.push_back(need("stiffness_" + std::to_string(part)));
  for (int knot = 1; physical.contains("rest_curvature_x" + std::to_string(knot)); ++knot)
    found.rest_curvature.push_back({need("rest_curvature_x" + std::to_string(knot)),
                                    need("rest_curvature_y" + std::to_string(knot))});
  return found;
}

Start make_start(const Array& places, const Array& points, const Array& velocities,
                 const std::optional<Array>& features, const std::optional<Array>& directions) {
  Start found{rows<double>("places", places), rows<Point>("points", points),
              rows<Point>("velocities", velocities), rows<double>("features", features),
              rows<Point>("directions", directions, false)};
  const std::size_t n = found.places.size();
  require(n > 2 && n <= kMostNodes && found.points.size() == n && found.velocities.size() == n &&
              (found.features.empty() || found.features.size() == n) &&
              (found.directions.empty() || found.directions.size() == n - 1),
          "start: got arrays of different lengths, fewer than 3 nodes, or more than " +
              std::to_string(kMostNodes));
  for (std::size_t i = 1; i < n; ++i)
    require(found.places[i] > found.places[i - 1], "places: got arc lengths that do not increase");
  return found;
}

std::vector<int> checked_nodes(std::vector<int> nodes) {
  for (int node : nodes)
    require(node >= 0 && node < static_cast<int>(kMostNodes), "nodes: got one below 0, or too large a one");
  return nodes;
}

Grip make_grip(std::vector<int> rows_, const Array& positions, const std::optional<Array>& rotations,
               const Array& turns) {
  Grip found{std::move(rows_), rows<Point>("positions", positions), rows<Matrix>("rotations", rotations),
             rows<Matrix>("turns", turns)};
  const std::size_t steps = found.positions.size();
  require(steps > 0 && found.turns.size() == steps &&
              (found.rotations.empty() || found.rotations.size() == steps),
          "grip: got arrays of different lengths, or none");
  return found;
}

Event make_close(int row, std::vector<int> nodes, const Array& position) {
  require(row >= 0, "row: got a negative one");
  return {Close{row, checked_nodes(std::move(nodes)), point("position", position)}};
}

Event make_hold(std::vector<int> nodes) { return {Hold{checked_nodes(std::move(nodes))}}; }

double require_share(double share) {
  require(share >= 0.0 && share <= 1.0, "share: got none from 0 to 1");
  return share;
}

Event make_advance(std::vector<std::shared_ptr<const Grip>> grips, int count, bool settles, bool remembers,
                   const std::vector<std::pair<int, double>>& sights) {
  require(count > 0, "count: got no steps");
  for (const auto& grip : grips) require(grip != nullptr, "grips: got None");
  Advance found{std::move(grips), count, settles, remembers, {}};
  for (const auto& [after, share] : sights) {
    require(after >= (found.sights.empty() ? 0 : found.sights.back().after) && after <= count,
            "sights: got some out of order, or after the last step");
    found.sights.push_back({after, require_share(share)});
  }
  return {std::move(found)};
}

Event make_see(std::optional<double> share) { return {See{!share, require_share(share.value_or(1.0))}}; }

Script make_script(std::vector<std::shared_ptr<const Event>> events, double distance, int steps) {
  require(steps >= kFewestStableSteps && steps <= kMostStableSteps,
          "stable_steps: got fewer than " + std::to_string(kFewestStableSteps) + ", or more than " +
              std::to_string(kMostStableSteps));
  Script script{std::move(events), {distance, steps}, 0, 0};
  std::size_t held = 0;
  const auto need = [&](const std::vector<int>& nodes) {
    for (int node : nodes) script.nodes = std::max(script.nodes, node + 1);
  };
  for (const auto& event : script.events) {
    require(event != nullptr, "events: got None");
    if (const auto* close = std::get_if<Close>(&event->is)) {
      require(close->row <= script.rows, "row: got one that does not follow those before");
      script.rows = std::max(script.rows, close->row + static_cast<int>(close->nodes.size()));
      need(close->nodes);
    } else if (const auto* hold = std::get_if<Hold>(&event->is)) {
      held = hold->nodes.size();
      need(hold->nodes);
    } else if (const auto* advance = std::get_if<Advance>(&event->is)) {
      std::size_t gripped = 0;
      for (const auto& grip : advance->grips) {
        gripped += grip->rows.size();
        for (int row : grip->rows)
          require(row >= 0 && row < script.rows, "grips: got a row that no hand has closed at");
      }
      require(gripped == held, "grips: got those of other nodes than are held");
    }
  }
  return script;
}

void require_step(double step) {
  require(step > 0.0, "time_step: got none");
  require_finite("time_step", step);
}

/// A flag that one thread sets and others read.
struct Stop {
  std::atomic<bool> flag{false};
};

using JobTuple = std::tuple<std::shared_ptr<const Script>, std::shared_ptr<const Start>, py::object, double>;

void require_fit(const Script& script, std::size_t nodes) {
  require(script.nodes <= static_cast<int>(nodes), "script: got one of a DLO of more nodes");
}

/// Nodes at the goals (g, N, 3), settled (g,), and steps; None: the rollout diverged.
py::object answer(const Outcome& outcome) {
  const std::size_t nodes = outcome.seen.empty() ? 0 : outcome.seen[0].size();
  Array seen({outcome.seen.size(), nodes, std::size_t{3}});
  for (std::size_t k = 0; k < outcome.seen.size(); ++k)
    std::copy_n(&outcome.seen[k][0].x, 3 * nodes, seen.mutable_data(k, 0, 0));
  if (outcome.diverged || !all_finite(seen)) return py::none();
  return py::make_tuple(seen, py::tuple(py::cast(outcome.settled)), outcome.steps);
}

py::list roll_out(const std::vector<JobTuple>& given, double time_step, const Stop* stop,
                  const std::string& target) {
  static const Stop never;
  const auto& known = targets();
  const auto chosen = std::find_if(known.begin(), known.end(), [&](const Target& one) {
    return target.empty() || target == one.name;
  });
  require(chosen != known.end(), "target: got one that this processor lacks");
  require_step(time_step);
  std::vector<Job> jobs;
  for (const auto& [script, start, physical, level] : given) {
    require(script && start, "jobs: got None");
    require_fit(*script, start->points.size());
    require_finite("level", level);
    jobs.push_back({script, start, properties_of(physical), time_step, level});
  }
  std::vector<Outcome> outcomes;
  {
    py::gil_scoped_release released;
    outcomes = chosen->roll_out(jobs, (stop ? stop : &never)->flag);
  }
  py::list found;
  for (const Outcome& one : outcomes) found.append(answer(one));
  return found;
}

/// While a rope follows a script, the script alone holds and aims it.
void require_free(const Rope& rope) {
  require(!rope.follows, "rope: got a call that only the script it follows may make");
}

void aim(Rope& rope, const Array& targets, const std::optional<Array>& turns) {
  require_free(rope);
  auto where = rows<Point>("targets", targets);
  auto how = rows<Matrix>("turns", turns);
  require(where.size() == rope.held.size(), "targets: got those of other nodes than are held");
  require(how.empty() || how.size() == rope.held.size(), "turns: got those of other nodes than are held");
  rope.targets = std::move(where), rope.turns = std::move(how);
}

py::object follow_script(Rope& rope, const Script& script, const std::function<void()>& step) {
  require_free(rope);
  require_fit(script, rope.rods.points.size());
  require(step != nullptr, "step: got None");
  const std::unique_ptr<bool, void (*)(bool*)> until_its_end(&rope.follows, [](bool* on) { *on = false; });
  rope.follows = true;
  return answer(follow(script, rope, step));
}

py::dict state_of(const Rope& rope) {
  const Rods<double>& rods = rope.rods;
  py::list clamps;
  for (const Clamp& one : rope.clamps)
    clamps.append(py::make_tuple(one.segment, array_of(std::vector<Point>{one.direction}).squeeze()));
  return py::dict(
      "drag"_a = rods.drag, "implicit"_a = rods.implicit, "rest_lengths"_a = array_of(rods.rest_lengths),
      "stiffness"_a = array_of(rods.stiffness), "masses"_a = array_of(rods.masses),
      "bending"_a = array_of(rods.bending), "natural"_a = array_of(rods.natural),
      "twisting"_a = array_of(rods.twisting), "angles"_a = array_of(rods.angles),
      "carried"_a = array_of(rods.carried), "joints"_a = array_of(rods.joints), "clamps"_a = clamps,
      "strands"_a = array_of(rods.strands), "plastic"_a = array_of(rods.plastic),
      "strand_forces"_a = array_of(rods.strand_forces),
      "frame_impulses"_a = array_of(rods.frame_impulses), "diameter"_a = rope.contact.diameter,
      "apart"_a = rope.contact.apart, "half"_a = array_of(rope.contact.half),
      "middles"_a = array_of(rope.contact.middles), "distances"_a = array_of(rope.contact.distances));
}

void define_rope(py::module_& module) {
  py::class_<Rope> rope(module, "Rope", py::module_local());
  rope.def(py::init([](const Start& start, const py::object& physical, double time_step, double level,
                       const Array& gravity) {
             require_step(time_step);
             require_finite("level", level);
             return std::make_unique<Rope>(start, properties_of(physical), time_step,
                                           point("gravity", gravity), level);
           }),
           "start"_a, "physical"_a, "time_step"_a, "level"_a, "gravity"_a);
  const auto share = [&](const char* name, auto member) {
    rope.def_property_readonly(name, [member](const py::object& self) {
      return array_of(member(self.cast<Rope&>()), self);
    });
  };
  share("points", [](Rope& one) -> auto& { return one.rods.points; });
  share("velocities", [](Rope& one) -> auto& { return one.rods.velocities; });
  share("predicted", [](Rope& one) -> auto& { return one.rods.predicted; });
  share("support", [](Rope& one) -> auto& { return one.rods.support; });
  share("inverse_masses", [](Rope& one) -> auto& { return one.inverse_masses; });
  rope.def_property_readonly("masses", [](const Rope& one) { return array_of(one.rods.masses); })
      .def_property_readonly("held", [](const Rope& one) { return one.held; })
      .def_property_readonly("targets", [](const Rope& one) { return array_of(one.targets); })
      .def_property_readonly("state", &state_of)
      .def("hold", [](Rope& one, const std::vector<int>& nodes) {
             require_free(one);
             for (int node : nodes)
               require(node >= 0 && node < one.rods.nodes, "nodes: got one that the DLO lacks");
             one.hold(nodes);
           }, "nodes"_a)
      .def("aim", &aim, "targets"_a, "turns"_a = py::none())
      .def("predict", [](Rope& one) { return predict(one); })
      .def("step", [](Rope& one) { return take_step(one); })
      .def("touch", &touch)
      .def("follow", &follow_script, "script"_a, "step"_a);
}

}  // namespace
}  // namespace dlo

PYBIND11_MODULE(_core, module) {
  using namespace dlo;
  py::list names;
  for (const Target& one : targets()) names.append(one.name);
  module.attr("TARGETS") = py::tuple(names);

  py::class_<Start, std::shared_ptr<Start>>(module, "Start", py::module_local())
      .def(py::init(&make_start), "places"_a, "points"_a, "velocities"_a, "features"_a = py::none(),
           "directions"_a = py::none());
  py::class_<Grip, std::shared_ptr<Grip>>(module, "Grip", py::module_local())
      .def(py::init(&make_grip), "rows"_a, "positions"_a, "rotations"_a, "turns"_a);
  py::class_<Event, std::shared_ptr<Event>>(module, "Event", py::module_local())
      .def_static("close", &make_close, "row"_a, "nodes"_a, "position"_a)
      .def_static("hold", &make_hold, "nodes"_a)
      .def_static("advance", &make_advance, "grips"_a, "count"_a, "settles"_a = false,
                  "remembers"_a = false, "sights"_a = std::vector<std::pair<int, double>>{})
      .def_static("see", &make_see, "share"_a = py::none());
  py::class_<Script, std::shared_ptr<Script>>(module, "Script", py::module_local())
      .def(py::init(&make_script), "events"_a, "stable_distance"_a, "stable_steps"_a);
  py::class_<Stop>(module, "Stop", py::module_local())
      .def(py::init())
      .def("set", [](Stop& stop) { stop.flag = true; })
      .def("is_set", [](const Stop& stop) { return stop.flag.load(); });
  define_rope(module);
  module.def("roll_out", &roll_out, "jobs"_a, "time_step"_a, "stop"_a = nullptr, "target"_a = "");
}
