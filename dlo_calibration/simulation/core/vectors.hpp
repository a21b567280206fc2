// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Vectors of numbers of one DLO, or of four.

#pragma once

#include <array>

namespace dlo {

// A Number is a double, or the doubles of four DLOs in SIMD lanes (`Lanes`).

constexpr int kMostNodes = 10000;  // of a DLO; the table of distances of segments grows with their square
constexpr int kLanes = 4;  // DLOs that are stepped together

/// How many DLOs a number belongs to.
template <class Number>
constexpr int lanes_of = sizeof(Number) / sizeof(double);

/// The number in one lane.
template <class Number>
inline double& in_lane(Number& number, int k) {
  return reinterpret_cast<double*>(&number)[k];
}

template <class Number>
struct Vec3 {
  Number x, y, z;
};

using Point = Vec3<double>;
using Matrix = std::array<double, 9>;  // row by row

template <class Number>
inline Point in_lane(Vec3<Number>& v, int k) {
  return {in_lane(v.x, k), in_lane(v.y, k), in_lane(v.z, k)};
}

template <class Number>
inline void set_lane(Vec3<Number>& v, int k, const Point& to) {
  in_lane(v.x, k) = to.x, in_lane(v.y, k) = to.y, in_lane(v.z, k) = to.z;
}

}  // namespace dlo
