// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Module: what Python sees.  All input is checked here, so that no step needs to.

#include <pybind11/functional.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <sstream>

#include "script.hpp"

namespace py = pybind11;
using namespace py::literals;

namespace dlo {
namespace {

using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;
constexpr std::size_t kMostBodies = 2000, kMostGridPoints = 1 << 24;
constexpr int kFewestStableSteps = 5, kMostStableSteps = 100000000;  // there are five checks within them

/// Raise a ValueError with a text, "thing: what came; expected what; remedy", unless a condition holds.
template <class... Parts>
void require(bool holds, const Parts&... parts) {
  if (holds) return;
  std::ostringstream text;
  (text << ... << parts);
  throw py::value_error(text.str());
}

void require_finite(const char* name, double number) {
  require(std::isfinite(number), name, ": ", number, "; expected a finite number; replace it");
}

bool all_finite(const Array& array) {
  return std::all_of(array.data(), array.data() + array.size(), [](double x) { return std::isfinite(x); });
}

/// The rows of an array (n, ...); each has as many numbers as a `Row`.
template <class Row>
std::vector<Row> rows(const char* name, const Array& array, bool finite = true) {
  constexpr py::ssize_t kNumbers = sizeof(Row) / sizeof(double);
  const py::ssize_t n = array.ndim() ? array.shape(0) : 0;
  require(array.size() == n * kNumbers, name, ": ", array.size(), " numbers in ", n, " rows; expected ",
          kNumbers, " in each row; reshape the array");
  require(!finite || all_finite(array), name,
          ": a number that is not finite; expected finite ones; replace it");
  std::vector<Row> result(n);
  std::copy_n(array.data(), array.size(), reinterpret_cast<double*>(result.data()));
  return result;
}

template <class Row>
std::vector<Row> rows(const char* name, const std::optional<Array>& array, bool finite = true) {
  return array ? rows<Row>(name, *array, finite) : std::vector<Row>{};
}

Point point(const char* name, const Array& array) {
  require(array.size() == 3, name, ": ", array.size(), " numbers; expected 3; give x, y and z");
  for (int c = 0; c < 3; ++c) require_finite(name, array.data()[c]);
  return {array.data()[0], array.data()[1], array.data()[2]};
}

/// The array (n, ...) of the numbers of rows: a view into the memory of `owner`, or a copy without an owner.
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
    throw py::type_error(
        "physical: no mapping; expected numbers by parameter name, in SI units; pass a dict");
  }
  const auto get = [&](const std::string& name, double otherwise) {
    try {
      return physical.contains(name) ? physical[name.c_str()].cast<double>() : otherwise;
    } catch (const py::cast_error&) {
      throw py::type_error(name + ": no number; expected one in SI units; convert it");
    }
  };
  const auto need = [&](const std::string& name) {
    if (!physical.contains(name)) throw py::key_error(name);
    return get(name, 0.0);
  };
  Properties properties;
  properties.bending_stiffness = need("flexibility"), properties.stretching_stiffness = need("elasticity");
  properties.mass = need("mass"), properties.drag = need("damping");
  properties.internal_damping = need("internal_damping"), properties.friction = need("friction");
  properties.radius = need("self_collision"), properties.length_scale = get("length_scale", 1.0);
  properties.natural_curvature = get("natural_curvature", 0.0);
  properties.marker_mass = get("marker_mass", 0.0), properties.torsion = get("torsion", 0.0);
  properties.bending_friction = get("bending_friction", 0.0);
  properties.bending_slip = get("bending_slip", 0.1), properties.locking = get("locking", 0.0);
  properties.clamp_twist = get("clamp_twist", 0.0);
  for (int part = 2; physical.contains("stiffness_" + std::to_string(part)); ++part)
    properties.profile.push_back(need("stiffness_" + std::to_string(part)));
  for (int knot = 2; physical.contains("stiffness_knot_" + std::to_string(knot)); ++knot)
    properties.stiffness_knots.push_back(need("stiffness_knot_" + std::to_string(knot)));
  for (int knot = 1; physical.contains("rest_curvature_x" + std::to_string(knot)); ++knot)
    properties.rest_curvature.push_back({need("rest_curvature_x" + std::to_string(knot)),
                                         need("rest_curvature_y" + std::to_string(knot))});
  for (int clamp : {0, 1})
    for (int axis : {0, 1})
      properties.clamp_bends[clamp][axis] =
          get("clamp_bend_" + std::string(axis ? "y" : "x") + std::to_string(clamp + 1), 0.0);
  return properties;
}

Start make_start(const Array& places, const Array& points, const Array& velocities,
                 const std::optional<Array>& features, const std::optional<Array>& directions) {
  Start start{rows<double>("places", places), rows<Point>("points", points),
              rows<Point>("velocities", velocities), rows<double>("features", features),
              rows<Point>("directions", directions, false)};
  const std::size_t n = start.places.size();
  require(n > 2 && n <= std::size_t{kMostNodes}, "start: ", n, " nodes; expected 3 to ", kMostNodes,
          "; choose another number of nodes");
  require(start.points.size() == n && start.velocities.size() == n &&
              (start.features.empty() || start.features.size() == n) &&
              (start.directions.empty() || start.directions.size() == n - 1),
          "start: arrays of different lengths; expected ", n, " rows, or ", n - 1,
          " directions; give one row per node");
  for (std::size_t i = 1; i < n; ++i)
    require(start.places[i] > start.places[i - 1], "places: ", start.places[i], " m after ",
            start.places[i - 1], " m; expected arc lengths that increase; sort the nodes");
  return start;
}

std::vector<int> checked_nodes(std::vector<int> nodes) {
  for (int node : nodes)
    require(node >= 0 && node < kMostNodes, "nodes: ", node, "; expected 0 to ",
            kMostNodes - 1, "; give the index of a node");
  return nodes;
}

Grip make_grip(std::vector<int> rows_, const Array& positions, const std::optional<Array>& rotations,
               const Array& turns) {
  Grip grip{std::move(rows_), rows<Point>("positions", positions), rows<Matrix>("rotations", rotations),
            rows<Matrix>("turns", turns)};
  const std::size_t steps = grip.positions.size();
  require(steps > 0 && grip.turns.size() == steps &&
              (grip.rotations.empty() || grip.rotations.size() == steps),
          "grip: ", steps, " positions, ", grip.rotations.size(), " rotations and ", grip.turns.size(),
          " turns; expected the same number of each, at least 1; give one of each per step");
  return grip;
}

Event make_close(int row, std::vector<int> nodes, const Array& position) {
  require(row >= 0, "row: ", row, "; expected 0 or more; count the rows from 0");
  return {Close{row, checked_nodes(std::move(nodes)), point("position", position)}};
}

Event make_hold(std::vector<int> nodes) { return {Hold{checked_nodes(std::move(nodes))}}; }

double require_share(double share) {
  require(share >= 0.0 && share <= 1.0, "share: ", share, "; expected 0 to 1; give a part of the step");
  return share;
}

Event make_advance(std::vector<std::shared_ptr<const Grip>> grips, int count, bool settles, bool remembers,
                   const std::vector<std::pair<int, double>>& sights) {
  require(count > 0, "count: ", count, " steps; expected 1 or more; leave the event out");
  for (const auto& grip : grips) require(grip != nullptr, "grips: None; expected a Grip; leave it out");
  Advance advance{std::move(grips), count, settles, remembers, {}};
  for (const auto& [after, share] : sights) {
    const int earliest = advance.sights.empty() ? 0 : advance.sights.back().after;
    require(after >= earliest && after <= count, "sights: a goal after ", after, " steps; expected ",
            earliest, " to ", count, "; sort the goals by time");
    advance.sights.push_back({after, require_share(share)});
  }
  return {std::move(advance)};
}

Event make_see(std::optional<double> share) { return {See{!share, require_share(share.value_or(1.0))}}; }

Script make_script(std::vector<std::shared_ptr<const Event>> events, double distance, int steps,
                   bool loads) {
  require(steps >= kFewestStableSteps && steps <= kMostStableSteps,
          "stable_steps: ", steps, "; expected ", kFewestStableSteps, " to ", kMostStableSteps,
          "; change the time step");
  Script script{std::move(events), {distance, steps}, 0, 0, loads};
  std::size_t held = 0;
  const auto need = [&](const std::vector<int>& nodes) {
    for (int node : nodes) script.nodes = std::max(script.nodes, node + 1);
  };
  for (const auto& event : script.events) {
    require(event != nullptr, "events: None; expected an Event; leave it out");
    if (const auto* close = std::get_if<Close>(&event->is)) {
      require(close->row <= script.rows, "row: ", close->row, "; expected 0 to ", script.rows,
              "; leave no row out");
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
          require(row >= 0 && row < script.rows, "grips: row ", row, "; expected a row below ", script.rows,
                  "; close the hand first");
      }
      require(gripped == held, "grips: ", gripped, " nodes; expected the ", held,
              " that are held; hold the gripped nodes first");
    }
  }
  return script;
}

/// Sizes [m] of a body by shape, as `Body` has them, and how far it reaches from its position.
Body make_body(const std::string& shape, const Array& sizes, const Array& position, double friction) {
  static const std::map<std::string, std::pair<Shape, py::ssize_t>> shapes = {
      {"sphere", {Shape::kSphere, 1}}, {"box", {Shape::kBox, 3}}, {"cylinder", {Shape::kCylinder, 2}},
      {"capsule", {Shape::kCapsule, 2}}};
  const auto entry = shapes.find(shape);
  require(entry != shapes.end(), "shape: ", shape, "; expected sphere, box, cylinder or capsule; use a grid");
  require(sizes.size() == entry->second.second, "sizes: ", sizes.size(), " numbers; expected ",
          entry->second.second, " of a ", shape, "; give as many");
  Body body{entry->second.first, {}, point("position", position), {}, friction, 0.0, nullptr};
  for (py::ssize_t k = 0; k < sizes.size(); ++k) {
    body.sizes[k] = sizes.data()[k];
    require(body.sizes[k] > 0.0 && std::isfinite(body.sizes[k]), "sizes: ", body.sizes[k],
            " m; expected a positive finite number; replace it");
  }
  const auto& [a, b, c] = body.sizes;
  body.reach = body.shape == Shape::kSphere ? a : body.shape == Shape::kBox ? std::sqrt(a * a + b * b + c * c)
               : body.shape == Shape::kCylinder ? std::sqrt(a * a + b * b) : a + b;
  return body;
}

Body with_pose(Body body, const Array& turn, double friction) {
  require(turn.size() == 9 && all_finite(turn), "turn: ", turn.size(), " numbers; expected the 9 finite "
          "ones of a rotation matrix; give them row by row");
  std::copy_n(turn.data(), 9, body.turn.data());
  require(friction >= 0.0 && std::isfinite(friction), "friction: ", friction,
          "; expected a finite number, 0 or more; replace it");
  return body;
}

std::shared_ptr<Grid> make_grid(const py::array_t<float, py::array::c_style | py::array::forcecast>& distances,
                                const Array& corner, double cell) {
  require(distances.ndim() == 3 && distances.size() <= static_cast<py::ssize_t>(kMostGridPoints),
          "distances: ", distances.ndim(), " dimensions and ", distances.size(), " numbers; expected 3, and at "
          "most ", kMostGridPoints, "; choose a larger cell");
  require(cell > 0.0 && std::isfinite(cell), "cell: ", cell, " m; expected a positive finite number; replace it");
  Grid grid{point("corner", corner), cell, {}, {distances.data(), distances.data() + distances.size()}};
  for (int c = 0; c < 3; ++c) {
    grid.counts[c] = static_cast<int>(distances.shape(c));
    require(grid.counts[c] > 1, "distances: ", grid.counts[c], " points in one direction; expected 2 or more; "
            "choose a smaller cell");
  }
  for (float distance : grid.distances)
    require(std::isfinite(distance), "distances: a number that is not finite; expected finite ones; replace it");
  return std::make_shared<Grid>(std::move(grid));
}

std::shared_ptr<Body> make_grid_body(const std::shared_ptr<const Grid>& grid, const Array& position,
                                     const Array& turn, double friction) {
  require(grid != nullptr, "grid: None; expected a Grid; make one");
  const auto furthest = [&](double from, int count) {
    return std::max(std::abs(from), std::abs(from + grid->cell * (count - 1)));
  };
  const double x = furthest(grid->corner.x, grid->counts[0]), y = furthest(grid->corner.y, grid->counts[1]),
               z = furthest(grid->corner.z, grid->counts[2]);
  return std::make_shared<Body>(with_pose({Shape::kGrid, {}, point("position", position), {}, friction,
                                           std::sqrt(x * x + y * y + z * z), grid}, turn, friction));
}

std::shared_ptr<Scene> make_scene(const std::vector<std::shared_ptr<const Body>>& bodies) {
  require(bodies.size() <= kMostBodies, "bodies: ", bodies.size(), "; expected at most ", kMostBodies,
          "; leave some out");
  auto scene = std::make_shared<Scene>();
  for (const auto& body : bodies) {
    require(body != nullptr, "bodies: None; expected a Body; leave it out");
    scene->bodies.push_back(*body);
  }
  return scene;
}

void require_step(double step) {
  require(step > 0.0 && std::isfinite(step), "time_step: ", step,
          " s; expected a positive finite time; choose another time step");
}

/// A flag that one thread sets and others read.
struct Stop {
  std::atomic<bool> flag{false};
};

using JobTuple = std::tuple<std::shared_ptr<const Script>, std::shared_ptr<const Start>, py::object, double>;

void require_fit(const Script& script, std::size_t nodes) {
  require(script.nodes <= static_cast<int>(nodes), "script: ", script.nodes,
          " nodes; expected at most the ", nodes, " of the DLO; write the script for this DLO");
}

/// Vectors at the nodes, for each goal (g, N, 3).
Array at_nodes(const std::vector<std::vector<Point>>& goals) {
  const std::size_t nodes = goals.empty() ? 0 : goals[0].size();
  Array rows({goals.size(), nodes, std::size_t{3}});
  for (std::size_t k = 0; k < goals.size(); ++k) std::copy_n(&goals[k][0].x, 3 * nodes, rows.mutable_data(k, 0, 0));
  return rows;
}

/// Nodes at the goals (g, N, 3), settled (g,), steps, loads (g, 3, 2), or None if they were not measured, and the
/// forces that hold nodes at the goals (g, N, 3); None: the rollout diverged.
py::object answer(const Outcome& outcome) {
  const Array seen = at_nodes(outcome.seen);
  if (outcome.diverged || !all_finite(seen)) return py::none();
  py::object loads = py::none();
  if (!outcome.loads.empty()) {
    static_assert(sizeof(Loads) == 6 * sizeof(double));
    loads = Array({outcome.loads.size(), std::size_t{3}, std::size_t{2}}, &outcome.loads[0].curvature.value);
  }
  return py::make_tuple(seen, py::tuple(py::cast(outcome.settled)), outcome.steps, loads, at_nodes(outcome.forces));
}

py::list roll_out(const std::vector<JobTuple>& tuples, double time_step, const Stop* stop,
                  const std::string& name, const std::shared_ptr<const Scene>& scene) {
  static const Stop never;
  const auto target = std::find_if(targets().begin(), targets().end(), [&](const Target& candidate) {
    return name.empty() || name == candidate.name;
  });
  require(target != targets().end(), "target: ", name, "; expected one of TARGETS; leave it out");
  require_step(time_step);
  std::vector<Job> jobs;
  for (const auto& [script, start, physical, level] : tuples) {
    require(script && start, "jobs: None; expected a Script and a Start; leave the job out");
    require_fit(*script, start->points.size());
    require_finite("level", level);
    jobs.push_back({script, start, properties_of(physical), time_step, level, scene});
  }
  std::vector<Outcome> outcomes;
  {
    py::gil_scoped_release released;
    outcomes = target->roll_out(jobs, (stop ? stop : &never)->flag);
  }
  py::list answers;
  for (const Outcome& outcome : outcomes) answers.append(answer(outcome));
  return answers;
}

/// While a rope follows a script, only the script holds and aims it.
void require_free(const Rope& rope) {
  require(!rope.follows, "rope: hold, aim or follow while it follows a script; expected only steps; "
                         "return from `follow` first");
}

void aim(Rope& rope, const Array& targets, const std::optional<Array>& turns) {
  require_free(rope);
  auto points = rows<Point>("targets", targets);
  auto rotations = rows<Matrix>("turns", turns);
  const std::size_t held = rope.held.size();
  require(points.size() == held, "targets: ", points.size(), " rows; expected ", held,
          "; give one per held node");
  require(rotations.empty() || rotations.size() == held, "turns: ", rotations.size(), " rows; expected ",
          held, "; give one per held node");
  rope.targets = std::move(points), rope.turns = std::move(rotations);
}

py::object follow_script(Rope& rope, const Script& script, const std::function<void()>& step) {
  require_free(rope);
  require_fit(script, rope.rods.points.size());
  require(step != nullptr, "step: None; expected a function; pass one that takes a step");
  const std::unique_ptr<bool, void (*)(bool*)> reset(&rope.follows, [](bool* flag) { *flag = false; });
  rope.follows = true;
  return answer(follow(script, rope, step));
}

py::dict state_of(const Rope& rope) {
  const Rods<double>& rods = rope.rods;
  py::list clamps;
  for (const Clamp& clamp : rope.clamps)
    clamps.append(py::make_tuple(clamp.segment, array_of(std::vector<Point>{clamp.direction}).squeeze()));
  return py::dict(
      "drag"_a = rods.drag, "implicit"_a = rods.implicit, "surplus"_a = rods.surplus,
      "rest_lengths"_a = array_of(rods.rest_lengths),
      "stiffness"_a = array_of(rods.stiffness), "masses"_a = array_of(rods.masses),
      "bending"_a = array_of(rods.bending), "natural"_a = array_of(rods.natural),
      "twisting"_a = array_of(rods.twisting), "angles"_a = array_of(rods.angles),
      "bishop"_a = array_of(rods.bishop), "joints"_a = array_of(rods.joints), "clamps"_a = clamps,
      "strands"_a = array_of(rods.strands), "plastic"_a = array_of(rods.plastic),
      "strand_forces"_a = array_of(rods.strand_forces), "locking"_a = array_of(rods.locking),
      "frame_impulses"_a = array_of(rods.frame_impulses));
}

void define_rope(py::module_& module) {
  py::class_<Rope> type(module, "Rope", py::module_local());
  type.def(py::init([](const Start& start, const py::object& physical, double time_step, double level,
                       const Array& gravity, std::shared_ptr<const Scene> scene) {
             require_step(time_step);
             require_finite("level", level);
             return std::make_unique<Rope>(start, properties_of(physical), time_step,
                                           point("gravity", gravity), level, std::move(scene));
           }),
           "start"_a, "physical"_a, "time_step"_a, "level"_a, "gravity"_a, "scene"_a = py::none());
  const auto share = [&](const char* name, auto member) {
    type.def_property_readonly(name, [member](const py::object& self) {
      return array_of(member(self.cast<Rope&>()), self);
    });
  };
  share("points", [](Rope& rope) -> auto& { return rope.rods.points; });
  share("velocities", [](Rope& rope) -> auto& { return rope.rods.velocities; });
  share("predicted", [](Rope& rope) -> auto& { return rope.rods.predicted; });
  share("support", [](Rope& rope) -> auto& { return rope.rods.support; });
  type.def_property_readonly("masses", [](const Rope& rope) { return array_of(rope.rods.masses); })
      .def_property_readonly("held", [](const Rope& rope) { return rope.held; })
      .def_property_readonly("targets", [](const Rope& rope) { return array_of(rope.targets); })
      .def_property_readonly("state", &state_of)
      .def("hold", [](Rope& rope, const std::vector<int>& nodes) {
             require_free(rope);
             for (int node : nodes)
               require(node >= 0 && node < rope.rods.nodes, "nodes: ", node, "; expected 0 to ",
                       rope.rods.nodes - 1, "; give the index of a node");
             rope.hold(nodes);
           }, "nodes"_a)
      .def("aim", &aim, "targets"_a, "turns"_a = py::none())
      .def("predict", [](Rope& rope) { return predict(rope); })
      .def("step", [](Rope& rope) { return take_step(rope); })
      .def("follow", &follow_script, "script"_a, "step"_a);
}

}  // namespace
}  // namespace dlo

PYBIND11_MODULE(_core, module) {
  using namespace dlo;
  py::list names;
  for (const Target& target : targets()) names.append(target.name);
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
      .def(py::init(&make_script), "events"_a, "stable_distance"_a, "stable_steps"_a, "loads"_a = false);
  py::class_<Grid, std::shared_ptr<Grid>>(module, "Grid", py::module_local())
      .def(py::init(&make_grid), "distances"_a, "corner"_a, "cell"_a);
  py::class_<Body, std::shared_ptr<Body>>(module, "Body", py::module_local())
      .def(py::init([](const std::string& shape, const Array& sizes, const Array& position, const Array& turn,
                       double friction) {
             return std::make_shared<Body>(
                 with_pose(make_body(shape, sizes, position, friction), turn, friction));
           }),
           "shape"_a, "sizes"_a, "position"_a, "turn"_a, "friction"_a)
      .def_static("of_grid", &make_grid_body, "grid"_a, "position"_a, "turn"_a, "friction"_a)
      .def("distance", [](const Body& body, const Array& at) { return distance(body, point("at", at)); }, "at"_a);
  py::class_<Scene, std::shared_ptr<Scene>>(module, "Scene", py::module_local())
      .def(py::init(&make_scene), "bodies"_a);
  py::class_<Stop>(module, "Stop", py::module_local())
      .def(py::init())
      .def("set", [](Stop& stop) { stop.flag = true; })
      .def("is_set", [](const Stop& stop) { return stop.flag.load(); });
  define_rope(module);
  module.def("roll_out", &roll_out, "jobs"_a, "time_step"_a, "stop"_a = nullptr, "target"_a = "",
             "scene"_a = py::none());
}
