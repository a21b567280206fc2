// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// The contact of one DLO with itself in a step.

namespace dlo {
namespace DLO_TARGET {

constexpr int kIterations = 10;         // of the solver, as many as Bullet makes
constexpr double kPushOut = 0.8;        // share of a penetration that one step corrects
constexpr double kFastestPushOut = 0.8;  // m/s; so that the correction does not throw the DLO apart
constexpr double kSupported = 0.5;      // cosine between push and opposing support: the node is supported
constexpr double kUnsupported = 1e-6;   // m/s; a smaller change of velocity is rounding
constexpr double kWedged = 0.1;         // least share of the mobility; with less, all nodes of a pair yield
constexpr double kTiny = 1e-12;         // m or m/s; shorter vectors have no direction
constexpr double kThinSkin = 0.0001, kThickSkin = 0.008;  // m; bounds of the Verlet skin
constexpr double kSkinSteps = 10.0;     // between these, the skin is what nodes move in this number of steps

struct Closest {
  double s, t;  // 0 to 1: places on the first and on the second segment
  Point normal;
  double distance;
};

/// The closest points of two segments (Ericson, Real-Time Collision Detection, 5.1.9).
inline Closest closest(const Point* points, int first, int second) {
  const Point u = points[first + 1] - points[first], v = points[second + 1] - points[second];
  const Point r = points[first] - points[second];
  const double a = dot(u, u), e = dot(v, v), b = dot(u, v), c = dot(u, r), f = dot(v, r);
  const double determinant = a * e - b * b;
  double s = 0.5;
  if (!(determinant < 1e-9 * a * e)) s = min(max((b * f - c * e) / determinant, 0.0), 1.0);
  const double t = (b * s + f) / e, clipped = min(max(t, 0.0), 1.0);
  if (t != clipped) s = min(max((b * clipped - c) / a, 0.0), 1.0);
  const Point between = r + s * u - clipped * v;
  const double distance = sqrt(dot(between, between));
  if (!(distance > kTiny)) return {s, clipped, {0.0, 0.0, 1.0}, distance};
  return {s, clipped, {between.x / distance, between.y / distance, between.z / distance}, distance};
}

/// Find the pairs that can touch and whose gap is below `reach` [m].  After a segment that is far away, the
/// search skips those that are too near to it along the DLO to be in reach.
/// `stretch`: largest length of a segment, relative to its rest length.
inline void find_near(SelfContact& contact, const Point* points, double stretch, double reach) {
  const int segments = static_cast<int>(contact.half.size());
  const auto &half = contact.half, &middles = contact.middles;
  Spheres& at = contact.single;
  double longest = 0.0;
  for (int i = 0; i < segments; ++i) {
    at.x[i] = (points[i].x + points[i + 1].x) / 2;
    at.y[i] = (points[i].y + points[i + 1].y) / 2;
    at.z[i] = (points[i].z + points[i + 1].z) / 2;
    longest = max(longest, half[i]);
  }
  longest *= 2 * stretch;
  contact.near.clear();
  for (int i = 0; i < segments; ++i) {
    int j = i + 1;
    while (j < segments && middles[j] - middles[i] - half[j] - half[i] <= contact.least_arc) ++j;
    const double far = stretch * (half[i] + contact.diameter) + longest / 2 + reach;
    while (j < segments) {
      const Point away = {at.x[j] - at.x[i], at.y[j] - at.y[i], at.z[j] - at.z[i]};
      const double beyond = sqrt(dot(away, away)) - far;
      if (beyond > 0.0) {
        j += 1 + static_cast<int>(min(beyond / longest, static_cast<double>(segments)));
        continue;
      }
      if (closest(points, i, j).distance <= stretch * contact.diameter + reach)
        contact.near.push_back({i, j});
      ++j;
    }
  }
}

/// Set the least distances of pairs at the start, so that none is pushed apart.
inline void begin(SelfContact& contact, const Point* points) {
  const std::size_t segments = contact.half.size();
  contact.distances.assign(segments * segments, contact.diameter);
  find_near(contact, points, 1.0, 0.0);
  contact.overlaps = !contact.near.empty();
  for (const auto& [i, j] : contact.near)
    contact.distances[i * segments + j] = min(contact.diameter, closest(points, i, j).distance);
}

/// The least gap [m] between two spheres whose indices differ by `away`; four gaps at a time.
inline double least_gap(const Spheres& spheres, int count, int away) {
  const auto gap = [&](int i, auto load) {
    const auto x = load(spheres.x, i + away) - load(spheres.x, i);
    const auto y = load(spheres.y, i + away) - load(spheres.y, i);
    const auto z = load(spheres.z, i + away) - load(spheres.z, i);
    return sqrt(x * x + y * y + z * z) - load(spheres.radius, i + away) - load(spheres.radius, i);
  };
  Lanes gaps = each(HUGE_VAL);
  double least = HUGE_VAL;
  int i = 0;
  for (; i + kLanes <= count - away; i += kLanes)
    gaps = min(gaps, gap(i, [](const std::vector<double>& from, int k) {
      Lanes lanes;
      __builtin_memcpy(&lanes, &from[k], sizeof lanes);
      return lanes;
    }));
  for (; i < count - away; ++i)
    least = min(least, gap(i, [](const std::vector<double>& from, int k) { return from[k]; }));
  for (int lane = 0; lane < kLanes; ++lane) least = min(least, in_lane(gaps, lane));
  return least;
}

/// Compute how far nodes may move before any segments can touch.  Checking all pairs takes less time than a
/// search that branches.  Segments that are near along the DLO have one sphere each, others one per pair.
inline void find_room(SelfContact& contact, const Point* points) {
  const double radius = contact.diameter / 2;
  const int segments = static_cast<int>(contact.half.size()), twins = (segments + 1) / 2;
  Spheres &single = contact.single, &twin = contact.twin;
  for (int i = 0; i < segments; ++i) {
    const Point length = points[i + 1] - points[i];
    single.x[i] = (points[i].x + points[i + 1].x) / 2;
    single.y[i] = (points[i].y + points[i + 1].y) / 2;
    single.z[i] = (points[i].z + points[i + 1].z) / 2;
    single.radius[i] = radius + sqrt(dot(length, length)) / 2;
  }
  for (int k = 0; k < twins; ++k) {
    const int i = 2 * k + 1, after = i < segments ? i : segments - 1;
    twin.x[k] = points[i].x, twin.y[k] = points[i].y, twin.z[k] = points[i].z;
    twin.radius[k] = 2 * max(single.radius[i - 1], single.radius[after]) - radius;
  }
  const int first = 2 + contact.next_segment / 2;
  contact.room_beside = contact.room_away = HUGE_VAL;
  for (int away = contact.next_segment; away < 2 * first - 1 && away < segments; ++away)
    contact.room_beside = min(contact.room_beside, least_gap(single, segments, away) / (away + 1));
  for (int away = first; away < twins; ++away)
    contact.room_away = min(contact.room_away, least_gap(twin, twins, away));
}

/// Return whether the DLO may touch itself in a step.  `current` returns its points, and is called only if
/// they are needed.
template <class Current>
inline bool is_near(SelfContact& contact, Movement last, Movement coming, Current current) {
  contact.room_beside -= last.neighbours;
  contact.room_away -= last.any;
  contact.room_near -= last.any;
  const auto has_room = [&] {
    return contact.room_beside >= coming.neighbours && contact.room_away >= coming.any;
  };
  if (has_room()) return false;
  if (contact.room_near < coming.any) {
    const Point* const points = current();
    find_room(contact, points);
    if (has_room()) {
      contact.room_near = -1.0;
      contact.near.clear();
      if (contact.overlaps) {
        for (double& distance : contact.distances) distance = contact.diameter;
        contact.overlaps = false;
      }
    } else {
      contact.room_near =
          coming.any + min(max(kThinSkin, kSkinSteps * coming.any), kThickSkin);
      find_near(contact, points, 1.2, contact.room_near);  // a segment may be stretched by 20 %
      contact.room_beside = contact.room_away = -1.0;
    }
  }
  return !contact.near.empty();
}

/// Find the near pairs that would come too close within a step.
inline void find_contacts(SelfContact& contact, const Point* points, const Point* velocities, double step) {
  contact.contacts.clear();
  for (const auto& [i, j] : contact.near) {
    const auto [s, t, normal, distance] = closest(points, i, j);
    double& allowed = contact.distances[i * contact.half.size() + j];
    allowed = max(allowed, min(distance, contact.diameter));
    const double gap = distance - allowed;
    const double least = gap > 0 ? -gap / step : min(-kPushOut * gap / step, kFastestPushOut);
    Contact pair{{i, i + 1, j, j + 1}, {1 - s, s, -(1 - t), -t}, {}, normal, 0.0, least, 0.0, {}};
    double approach = 0.0;
    for (int m = 0; m < 4; ++m) approach += pair.weights[m] * dot(velocities[pair.nodes[m]], normal);
    if (approach < least) contact.contacts.push_back(pair);
  }
}

/// Compute which nodes yield, and how much.  A node does not yield to a push towards a body that supports
/// it, but passes the push on to that body: a strand on a table carries another strand.
inline void prepare(SelfContact& contact, const double* inverse_masses, const Point* support) {
  auto& sharing = contact.change;  // x: number of contacts that share the node
  sharing.assign(sharing.size(), Point{});
  for (const Contact& pair : contact.contacts)
    for (int node : pair.nodes) sharing[node].x += 1.0;
  for (Contact& pair : contact.contacts) {
    double yielding = 0.0, full = 0.0, shared = 0.0;
    for (int m = 0; m < 4; ++m) {
      const int node = pair.nodes[m];
      const double w = pair.weights[m], sign = w > 0 ? 1.0 : w < 0 ? -1.0 : 0.0;
      const double backing = sign * dot(support[node], pair.normal);
      const double resistance = max(kSupported * sqrt(dot(support[node], support[node])), kUnsupported);
      pair.yielding[m] = backing > -resistance ? inverse_masses[node] : 0.0;
      yielding += w * w * pair.yielding[m];
      full += w * w * inverse_masses[node];
    }
    for (int m = 0; m < 4; ++m) {
      const int node = pair.nodes[m];
      if (yielding < kWedged * full) pair.yielding[m] = inverse_masses[node];
      shared += pair.weights[m] * pair.weights[m] * pair.yielding[m] * sharing[node].x;
    }
    pair.mobility = shared > 0 ? shared : HUGE_VAL;  // all nodes are held
  }
}

/// Make one iteration of the solver, with Coulomb friction.
inline void push_apart(SelfContact& contact, Point* velocities, int nodes) {
  auto& change = contact.change;
  change.assign(change.size(), Point{});
  for (Contact& pair : contact.contacts) {
    Point relative{};
    for (int m = 0; m < 4; ++m) relative = relative + pair.weights[m] * velocities[pair.nodes[m]];
    const double approach = dot(relative, pair.normal), mobility = pair.mobility;
    const double push = max(pair.normal_impulse + (pair.least - approach) / mobility, 0.0);
    const Point sliding = relative - approach * pair.normal, &before = pair.friction_impulse;
    const Point wanted = {before.x - sliding.x / mobility, before.y - sliding.y / mobility,
                          before.z - sliding.z / mobility};
    const double share =
        min(1.0, contact.friction * push / max(sqrt(dot(wanted, wanted)), kTiny));
    const Point rub = share * wanted;
    const Point impulse = rub - pair.friction_impulse + (push - pair.normal_impulse) * pair.normal;
    pair.friction_impulse = rub;
    pair.normal_impulse = push;
    for (int m = 0; m < 4; ++m)
      change[pair.nodes[m]] = change[pair.nodes[m]] + pair.weights[m] * pair.yielding[m] * impulse;
  }
  for (int i = 0; i < nodes; ++i) velocities[i] = velocities[i] + change[i];
}

/// Correct `velocities`, those without contact, so that near segments do not pass through each other.
/// Contacts are velocity constraints, solved by Jacobi iterations with mass splitting (Tonge et al., Mass
/// Splitting for Jitter-Free Parallel Rigid Body Simulation, 2012).
/// `support`: change of the velocities by other bodies in the last step [m/s].
inline void keep_apart(SelfContact& contact, const Point* points, Point* velocities, int nodes,
                       const double* inverse_masses, const Point* support, double step) {
  find_contacts(contact, points, velocities, step);
  if (contact.contacts.empty()) return;
  prepare(contact, inverse_masses, support);
  for (int k = 0; k < kIterations; ++k) push_apart(contact, velocities, nodes);
  // Nodes that did not yield pass the impulses on to the bodies that support them.
  for (const Contact& pair : contact.contacts)
    for (int m = 0; m < 4; ++m) {
      const int node = pair.nodes[m];
      const double weight = pair.weights[m] * (inverse_masses[node] - pair.yielding[m]);
      const Point impulse = pair.normal_impulse * pair.normal + pair.friction_impulse;
      velocities[node] = velocities[node] + weight * impulse;
    }
}

}  // namespace DLO_TARGET
}  // namespace dlo
