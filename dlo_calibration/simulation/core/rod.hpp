// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// The mass-spring chain, integrated implicitly, and its contact with a table.
//
// Springs of stiffness EA / l join neighbouring point masses.  Each inner node has the bending energy
// EI / (2 l) |t_i - t_(i-1)|^2, with t the segment vectors divided by their rest lengths (the discrete
// curvature of Bergou et al., Discrete Elastic Rods, 2008, without twist).  A step is
//
//     [M (1 + drag dt) + c K] v' = M v + dt f(x),    x' = x + dt v'
//
// With c = dt^2 this is the linearised backward Euler method of Baraff and Witkin, Large Steps in Cloth
// Simulation, 1998, equation 6.  For one mode of a linear spring, every c >= dt^2 / 2 is stable at any
// stiffness, and the determinant shows that c damps the mode like a stiffness-proportional damping of c / dt.
// So c is dt times the internal damping, but at least 0.6 dt^2 for stability (at 0.5 dt^2 the stiffest modes
// would ring for ever).  Of bending, the right side gives back c K v beyond the internal damping, so that
// vibrations fade alike for every time step; at least 0.2 dt^2 stay, to damp the stiffest modes.
//
// That holds for small movements alone: a taut DLO that vibrates across turns its stiff springs within a step,
// and gains energy until it flies away.  With c = dt^2 it does not; so the springs get that where the tension
// would move a node by the length of a segment within a step, T dt^2 / (l m) >= 1, and a share of it with less
// tension.  The negative part of the matrix of a compressed spring is omitted, so that the whole matrix stays
// positive definite.
//
// The part of a spring's matrix across its segment, its tension over its length, would damp the segment's
// turning, which nothing in a DLO does: a DLO that is dragged would rub as if friction were a few percent
// larger.  So the right side has the same part times v, and what is left is inertia.  A taut DLO needs the
// damping: what is returned falls from all at T dt^2 / (l m) = 1/2 to nothing at 1.
//
// A segment that turns by phi in a step is phi^2 / 2 longer after it, which the next step takes back.  Springs
// linearised where the last velocities lead, also smoothed ones, take a third of that error away where a DLO
// is dragged around a peg, but are unstable: in long steps, and where a rope is pulled taut around a peg,
// tensions grow without bound.

namespace dlo {
namespace DLO_TARGET {

constexpr double kHeld = 1e12;  // weight of the equation of a held node, relative to its mass

/// Compute the springs of all segments; those of one DLO four at a time, as roots and divisions take long.
template <class Number>
inline void find_springs(Rods<Number>& rods) {
  const int segments = rods.nodes - 1;
  const bool framed = rods.framed;
  const double step = rods.step;
  const Number implicit = rods.implicit, missing = max(step * step - implicit, 0.0);
  const auto* masses = rods.masses.data();
  const auto *points = rods.points.data();
  const auto *rest_lengths = rods.rest_lengths.data(), *stiffnesses = rods.stiffness.data();
  auto* springs = rods.springs.data();
  auto* tangents = rods.tangents.data();
  auto* inverse_lengths = rods.inverse_lengths.data();
  const auto spring = [&](auto inverse, auto rest_length, auto stiffness, auto mass) {
    using Result = decltype(inverse);
    const Result slack = 1.0 - rest_length * inverse;
    const Result across = max(slack, 0.0) * stiffness;
    const Result taut = min(across * (step * step) / mass, 1.0);
    const Result part = implicit + taut * missing;
    return Spring<Result>{across * part, part * (stiffness - across) * inverse * inverse,
                          stiffness * slack * step, across * part * min(2.0 - 2.0 * taut, 1.0)};
  };
  const auto segment = [&](int i) { return points[i + 1] - points[i]; };
  const auto square = [&](int i) { return dot(segment(i), segment(i)); };
  const auto put = [&](int i, const Spring<Number>& found, Number inverse) {
    springs[i] = found;
    if (framed) tangents[i] = inverse * segment(i), inverse_lengths[i] = inverse;
  };
  int i = 0;
  if constexpr (lanes_of<Number> == 1) {
    for (; i + 4 <= segments; i += 4) {
      Lanes inverses = 1.0 / sqrt(four(square(i), square(i + 1), square(i + 2), square(i + 3)));
      auto [across, along, impulse, returned] = spring(inverses, four(rest_lengths + i), four(stiffnesses + i),
                                                       min(four(masses + i), four(masses + i + 1)));
      for (int k = 0; k < 4; ++k)
        put(i + k, {in_lane(across, k), in_lane(along, k), in_lane(impulse, k), in_lane(returned, k)},
            in_lane(inverses, k));
    }
  }
  for (; i < segments; ++i) {
    const Number inverse = 1.0 / sqrt(square(i));
    put(i, spring(inverse, rest_lengths[i], stiffnesses[i], min(masses[i], masses[i + 1])), inverse);
  }
}

template <class Number>
inline void push_front(std::array<Number, kBand>& last, Number value) {
  last = {{value, value, last[1], last[2], last[3], last[4], last[5]}};
}

/// The elimination of the columns of four DLOs.  Each one is computed in one pass from the six before it.  The last
/// one stays in registers, so that the next pivot never waits for memory.
template <class Number>
class Elimination {
 public:
  explicit Elimination(Column<Number>* columns) : columns_(columns) {}

  /// Eliminate the next column, with its right side `value`; write that of L^T to `result`.
  template <class... Entries>
  void add(Number& result, Number value, Entries... entries) {
    Column<Number> column{{entries...}};
    subtract<6>(columns_[-6], column, value);
    subtract<5>(columns_[-5], column, value);
    subtract<4>(columns_[-4], column, value);
    subtract<3>(columns_[-3], column, value);
    subtract<2>(columns_[-2], column, value);
    subtract<1>(done_, column, value);
    smallest = min(smallest, column[0]);
    column[0] = 1.0 / column[0];
    push_front(last_, value);
    result = value * column[0];
    *columns_++ = done_ = column;
  }

  /// The entry of L in the row that is `rows` below the diagonal.
  static Number factor(const Column<Number>& column, int rows) { return column[rows] * column[0]; }

  Number smallest = Number{} + HUGE_VAL;  // pivot

 private:
  /// Subtract the share of the column that is `Back` columns before.
  template <int Back>
  void subtract(const Column<Number>& done, Column<Number>& column, Number& value) {
    const Number share = done[Back] * done[0];
    for (int m = 0; m + Back < kBand; ++m) column[m] = column[m] - share * done[Back + m];
    value = value - share * last_[Back];
  }

  Column<Number>* columns_;
  Column<Number> done_{};
  std::array<Number, kBand> last_{};  // right sides, from 1 on
};

/// That of one DLO, to the same bits.  The last six columns stay in registers, and move up by a row with each
/// column.  A column lies in two: its next three entries and its right side in `top`, the four below in `low`.
template <>
class Elimination<double> {
 public:
  explicit Elimination(Column<double>* columns) : columns_(columns) {}

  void add(double& result, double value, double a, double b, double c, double d, double e, double f, double g) {
    Lanes top = four(a, b, c, value), low = four(d, e, f, g);
    subtract<6>(top, low);
    subtract<5>(top, low);
    subtract<4>(top, low);
    subtract<3>(top, low);
    subtract<2>(top, low);
    // The next pivot waits for this one, but not for the other entries.
    const double pivot = in_lane(top, 0) - share_ * in_lane(tops_[1], 0), inverse = 1.0 / pivot;
    top = top - share_ * tops_[1], low = low - share_ * lows_[1];
    smallest = min(smallest, pivot);
    const Lanes factors = inverse * top;
    store(factors, &(*columns_)[0]), store(inverse * low, &(*columns_)[4]);
    result = (*columns_++)[3];
    for (int k = 6; k > 1; --k) tops_[k] = moved(tops_[k - 1], lows_[k - 1]);
    for (int k = 3; k > 1; --k) lows_[k] = moved(lows_[k - 1]);
    tops_[1] = moved(top, low), lows_[1] = moved(low);
    share_ = in_lane(tops_[1], 0) * inverse;
  }

  static double factor(const Column<double>& column, int rows) { return column[rows < 3 ? rows : rows + 1]; }

  double smallest = HUGE_VAL;  // pivot

 private:
  template <int Back>
  void subtract(Lanes& top, Lanes& low) const {
    const double share = factor(columns_[-Back], Back);
    top = top - share * tops_[Back];
    if constexpr (Back < 4) low = low - share * lows_[Back];
  }

  Column<double>* columns_;
  std::array<Lanes, kBand> tops_{}, lows_{};  // by how many columns they are back; `lows_` is 0 from 4 on
  double share_ = 0.0;                        // of the last column in the next one
};

/// Write the equations of a step and solve them by L D L^T (Golub and Van Loan, Matrix Computations, 4.3).
///
/// `strand_forces` and `frame_impulses` add the other internal forces, `holding` holds nodes, `touching` keeps
/// them out of bodies.  The solution is written to `predicted`, and whether it is finite to `solved`.
template <class Number>
inline void solve(Rods<Number>& rods) {
  const int n = rods.nodes;
  const bool framed = rods.framed, strands_rub = !rods.strand_forces.empty();
  const double step = rods.step;
  const Number drag = rods.drag, implicit = rods.implicit, surplus = rods.surplus;
  const auto* points = rods.points.data(), *velocities = rods.velocities.data();
  const auto* bending = rods.bending.data();
  const auto* masses = rods.masses.data();
  const auto* springs = rods.springs.data();
  const auto* strand_forces = rods.strand_forces.data();
  const auto* frame_impulses = rods.frame_impulses.data();
  const auto* holdings = rods.holding.data();
  const auto *any_held = rods.any_held.data(), *any_touching = rods.any_touching.data();
  auto* predicted = rods.predicted.data();
  Elimination<Number> elimination(rods.columns.data() + kBand - 1);
  const Point fall = step * rods.gravity;
  const Number none{};
  Number xx = none, yy = none, zz = none, xy = none, xz = none, yz = none;  // of the segment before
  Vec3<Number> before{};                                                    // its impulse
  const auto bent = [&](int k) { return step * points[k] - surplus * velocities[k]; };  // what bending resists
  Vec3<Number> bents[5] = {{}, {}, {}, bent(0), bent(1)};  // of nodes i - 2 to i + 2
  for (int i = 0; i < n; ++i) {
    for (int k = 0; k < 4; ++k) bents[k] = bents[k + 1];
    if (i + 2 < n) bents[4] = bent(i + 2);
    Vec3<Number> unbending = bending[i][0] * bents[2], segment{}, apart{};
    if (i + 1 < n) {
      segment = points[i + 1] - points[i], apart = velocities[i + 1] - velocities[i];
      unbending = unbending + bending[i][1] * bents[3];
    }
    if (i + 2 < n) unbending = unbending + bending[i][2] * bents[4];
    if (i > 0) unbending = unbending + bending[i - 1][1] * bents[1];
    if (i > 1) unbending = unbending + bending[i - 2][2] * bents[0];
    const Number mass = masses[i];
    Vec3<Number> impulse = mass * (velocities[i] + fall) - unbending;
    Number diagonal = mass * (1.0 + drag * step) + implicit * bending[i][0];
    Number first = implicit * bending[i][1], second = implicit * bending[i][2];
    if (strands_rub) {
      const StrandForce<Number>& strands = strand_forces[i];
      diagonal = diagonal + strands.matrix[0];
      first = first + strands.matrix[1], second = second + strands.matrix[2];
      impulse = impulse - strands.impulse;
    }
    const Number ax = diagonal + xx, ay = diagonal + yy, az = diagonal + zz, bxy = xy, bxz = xz, byz = yz;
    impulse = impulse - before;
    const Spring<Number>& spring = springs[i];  // nothing at the last node
    const auto& [x, y, z] = segment;
    xx = spring.along * x * x + spring.across, yy = spring.along * y * y + spring.across;
    zz = spring.along * z * z + spring.across;
    xy = spring.along * x * y, xz = spring.along * x * z, yz = spring.along * y * z;
    before = spring.impulse * segment - spring.returned * apart;
    impulse = impulse + before;
    Number dx = ax + xx, dy = ay + yy, dz = az + zz;
    if (framed) impulse = impulse + frame_impulses[i];
    if (any_held[i]) {
      const Holding<Number>& holding = holdings[i];
      dx = dx + holding.weight, dy = dy + holding.weight, dz = dz + holding.weight;
      impulse = impulse + holding.impulse;
    }
    Number dxy = bxy + xy, dxz = bxz + xz, dyz = byz + yz;
    Number nxx = first - xx, nyy = first - yy, nzz = first - zz, nxy = -xy, nxz = -xz, nyz = -yz;
    if (any_touching[i]) {
      const auto& [own, next_node, push] = rods.touching[i];
      dx = dx + own[0], dxy = dxy + own[1], dxz = dxz + own[2];
      dy = dy + own[3], dyz = dyz + own[4], dz = dz + own[5];
      nxx = nxx + next_node[0], nxy = nxy + next_node[1], nxz = nxz + next_node[2];
      nyy = nyy + next_node[3], nyz = nyz + next_node[4], nzz = nzz + next_node[5];
      impulse = impulse + push;
    }
    elimination.add(predicted[i].x, impulse.x, dx, dxy, dxz, nxx, nxy, nxz, second);
    elimination.add(predicted[i].y, impulse.y, dy, dyz, nxy, nyy, nyz, none, second);
    elimination.add(predicted[i].z, impulse.z, dz, nxz, nyz, nzz, none, none, second);
  }
  Number total = none;
  const Column<Number>* column = rods.columns.data() + kBand - 1 + 3 * n;
  std::array<Number, kBand> last{};  // numbers of the solution, from 1 on
  const auto back = [&](Number& result) {
    --column;
    Number value = result;
    for (int k = kBand - 1; k > 0; --k) value = value - Elimination<Number>::factor(*column, k) * last[k];
    push_front(last, value);
    total = total + value;
    result = value;
  };
  for (int i = n - 1; i >= 0; --i) back(predicted[i].z), back(predicted[i].y), back(predicted[i].x);
  rods.solved = select(finite(total) & (elimination.smallest > 0.0), none + 1.0, none);
}

/// Compute the tensions that the springs transmit in a step, as its equations have them: the force of the
/// spring and what its implicit damping adds.  The stretch alone would say too much wherever the step then
/// changes velocities by contact, or the segment turns: the damping opposes the way back.
template <class Number>
inline void find_tensions(Rods<Number>& rods) {
  const double step = rods.step;
  const auto *points = rods.points.data(), *velocities = rods.predicted.data();
  const auto* former = rods.velocities.data();
  const auto* springs = rods.springs.data();
  auto* tensions = rods.tensions.data();
  for (int i = 0; i + 1 < rods.nodes; ++i) {
    const Vec3<Number> segment = points[i + 1] - points[i], apart = velocities[i + 1] - velocities[i];
    const Number square = dot(segment, segment);
    const auto& [across, along, impulse, returned] = springs[i];
    const Vec3<Number> damped =
        (along * square + across) * apart - returned * (former[i + 1] - former[i]);
    tensions[i] = (impulse * square + dot(segment, damped)) / (step * sqrt(square));
  }
}

/// Upper bounds [m] of the relative movement of any two nodes, and of two neighbours, in a step.
template <class Number>
inline std::array<Number, 2> movement(const std::vector<Vec3<Number>>& rows, double step) {
  const std::size_t n = rows.size();
  const auto* velocities = rows.data();
  Number any{}, neighbours{};
  for (std::size_t i = 0; i < n; ++i) {
    const auto away = velocities[i] - velocities[n / 2], beside = velocities[i] - velocities[i ? i - 1 : 0];
    any = max(any, dot(away, away));
    neighbours = max(neighbours, dot(beside, beside));
  }
  return {2 * step * sqrt(any), step * sqrt(neighbours)};
}

/// Compute the velocities after contact with a table, with Coulomb friction, from `predicted`; take the step.
/// The constants are Bullet's (PyBullet 3.2.7), found by single steps of a sphere on a plane.
template <class Number>
inline void step_on_table(Rods<Number>& rods) {
  constexpr double kSlop = 1e-5;                        // m of penetration that is allowed
  const double margin = 0.02 * sqrt(3.0) * 0.005;  // m; further away, a sphere of 5 mm has no contact
  const double step = rods.step;
  const Number level = rods.level, friction = rods.friction;
  const auto* predicted = rods.predicted.data();
  auto *points = rods.points.data(), *velocities = rods.velocities.data(), *support = rods.support.data();
  for (int i = 0; i < rods.nodes; ++i) {
    Vec3<Number> v = predicted[i];
    const Number distance = points[i].z - level, depth = -(distance + kSlop);
    const Number wanted = select(depth > 0.0, 0.08 * depth, depth) / step;  // one step corrects 8 %
    const Number push = wanted - v.z;
    const auto touches = (distance < margin) & (push > 0.0);
    if (any(touches)) {
      const Number speed = sqrt(v.x * v.x + v.y * v.y);
      const Number share = select(speed > 0.0, 1.0 - min(1.0, friction * push / speed), 0.0);
      const Number scale = select(touches, share, 1.0);
      v = {scale * v.x, scale * v.y, select(touches, wanted, v.z)};
    }
    velocities[i] = v;
    support[i] = v - predicted[i];
    points[i] = points[i] + step * v;
  }
}

}  // namespace DLO_TARGET
}  // namespace dlo
