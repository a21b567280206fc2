// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Arithmetic: the same source computes with doubles and with lanes, for one target.
//
// Code for each target is in a namespace of its own, `DLO_TARGET`: the linker would keep only one copy of a
// function that two targets share.  Where lanes take different branches, both are computed and `select`
// chooses, inside `if (any(...))`, so that a lone DLO skips what it does not need.  No lane depends on another
// lane: each has the bits that its DLO has alone.

#include <cmath>

#include "rope.hpp"

namespace dlo {
namespace DLO_TARGET {

#ifdef DLO_AVX2
constexpr int kWidth = 4;  // doubles in a register
#else
constexpr int kWidth = 2;  // of SSE2 or NEON
#endif
constexpr int kParts = kLanes / kWidth;  // registers of a number
using Vector = double __attribute__((vector_size(8 * kWidth)));
using Bits = long long __attribute__((vector_size(8 * kWidth)));

/// The numbers of four DLOs; in memory they are plain doubles, see `in_lane`.
struct alignas(32) Lanes {
  Vector of[kParts];
};

/// The outcome of a comparison, lane by lane.
struct alignas(32) Mask {
  Bits of[kParts];
};

// The parts are not in a loop, because g++ would not keep the number in registers.
#define DLO_PART(number, expression) \
  if constexpr (number < kParts) { constexpr int k = number; result.of[k] = expression; }
#define DLO_LANEWISE(Result, expression)          \
  Result result;                                  \
  DLO_PART(0, expression) DLO_PART(1, expression) \
  return result

inline Lanes each(double x) { DLO_LANEWISE(Lanes, x - Vector{}); }

// Lanes also hold four numbers of one DLO.

inline Lanes four(double a, double b, double c, double d) {
#ifdef DLO_AVX2
  return {{Vector{a, b, c, d}}};
#else
  return {{Vector{a, b}, Vector{c, d}}};
#endif
}
inline Lanes four(const double* numbers) {
  Lanes result;
  __builtin_memcpy(&result, numbers, sizeof result);
  return result;
}

inline void store(Lanes a, double* numbers) { __builtin_memcpy(numbers, &a, sizeof a); }

/// The numbers 1, 2 and 3 of `a`, and 0.
inline Lanes moved(Lanes a) {
#ifdef DLO_AVX2
  return {{__builtin_shufflevector(a.of[0], Vector{}, 1, 2, 3, 4)}};
#else
  return {{__builtin_shufflevector(a.of[0], a.of[1], 1, 2), __builtin_shufflevector(a.of[1], Vector{}, 1, 2)}};
#endif
}

/// The numbers 1 and 2 of `a`, number 0 of `b`, and number 3 of `a`.
inline Lanes moved(Lanes a, Lanes b) {
#ifdef DLO_AVX2
  return {{__builtin_shufflevector(a.of[0], b.of[0], 1, 2, 4, 3)}};
#else
  return {{__builtin_shufflevector(a.of[0], a.of[1], 1, 2), __builtin_shufflevector(b.of[0], a.of[1], 0, 3)}};
#endif
}

#define DLO_OPERATOR(symbol, Result)                                                                \
  inline Result operator symbol(Lanes a, Lanes b) { DLO_LANEWISE(Result, a.of[k] symbol b.of[k]); } \
  inline Result operator symbol(Lanes a, double b) { return a symbol each(b); }                     \
  inline Result operator symbol(double a, Lanes b) { return each(a) symbol b; }
DLO_OPERATOR(+, Lanes)
DLO_OPERATOR(-, Lanes)
DLO_OPERATOR(*, Lanes)
DLO_OPERATOR(/, Lanes)
DLO_OPERATOR(<, Mask)
DLO_OPERATOR(>, Mask)
#undef DLO_OPERATOR
inline Lanes operator-(Lanes a) { DLO_LANEWISE(Lanes, -a.of[k]); }
inline Mask operator&(Mask a, Mask b) { DLO_LANEWISE(Mask, a.of[k] & b.of[k]); }

inline double select(bool choice, double a, double b) { return choice ? a : b; }
inline Lanes select(Mask choice, Lanes a, Lanes b) {
  DLO_LANEWISE(Lanes, choice.of[k] ? a.of[k] : b.of[k]);
}
inline Lanes select(Mask choice, double a, Lanes b) { return select(choice, each(a), b); }
inline Lanes select(Mask choice, Lanes a, double b) { return select(choice, a, each(b)); }
inline Lanes select(Mask choice, double a, double b) { return select(choice, each(a), each(b)); }

inline bool any(bool mask) { return mask; }
inline bool any(Mask mask) {
#ifdef DLO_AVX2
  return __builtin_ia32_movmskpd256(reinterpret_cast<Vector>(mask.of[0])) != 0;
#else
  const Bits either = mask.of[0] | mask.of[1];
  return (either[0] | either[1]) != 0;
#endif
}

// Comparisons with nan are false, so that `min(a, nan)` is a.
template <class A, class B>
inline auto min(A a, B b) { return select(b < a, b, a); }
template <class A, class B>
inline auto max(A a, B b) { return select(b > a, b, a); }

inline double sqrt(double x) { return __builtin_sqrt(x); }
inline Vector sqrt(Vector x) {
#if defined __clang__
  return __builtin_elementwise_sqrt(x);
#elif defined DLO_AVX2
  return __builtin_ia32_sqrtpd256(x);
#elif defined __SSE2__
  return __builtin_ia32_sqrtpd(x);
#else
  for (int k = 0; k < kWidth; ++k) x[k] = __builtin_sqrt(x[k]);
  return x;
#endif
}
inline Lanes sqrt(Lanes a) { DLO_LANEWISE(Lanes, sqrt(a.of[k])); }

template <class Number>
inline Number abs(Number x) { return select(x < 0.0, -x, x); }

template <class Number>
inline auto finite(Number x) { return abs(x) < HUGE_VAL; }

// Vectors, with numbers of either kind.

template <class A, class B>
inline auto operator+(const Vec3<A>& a, const Vec3<B>& b) {
  return Vec3<decltype(a.x + b.x)>{a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class A, class B>
inline auto operator-(const Vec3<A>& a, const Vec3<B>& b) {
  return Vec3<decltype(a.x - b.x)>{a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class A, class B>
inline auto operator*(A a, const Vec3<B>& b) {
  return Vec3<decltype(a * b.x)>{a * b.x, a * b.y, a * b.z};
}
template <class A, class B>
inline auto dot(const Vec3<A>& a, const Vec3<B>& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class A>
inline Vec3<A> cross(const Vec3<A>& a, const Vec3<A>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Point operator*(const Matrix& m, const Point& p) {
  return {m[0] * p.x + m[1] * p.y + m[2] * p.z, m[3] * p.x + m[4] * p.y + m[5] * p.z,
          m[6] * p.x + m[7] * p.y + m[8] * p.z};
}

// Angles.  The functions of the C library differ in their last bit from processor to processor; these use only
// sums, products, quotients and roots, and do not.  Errors of sine and cosine are below 3e-16, those of the angle
// below two units in the last place (Taylor series of the reduced argument).

struct Rotation {
  double cosine, sine;
};

/// Cosine and sine of an angle [rad] of less than a hundred thousand turns.
inline Rotation rotation(double angle) {
  // pi / 2 as a sum; the first part has 33 bits, so that its multiples are exact.
  constexpr double kQuarter = 1.5707963267341256, kRest = 6.077100506506192e-11;
  const double quarters = __builtin_nearbyint(angle / kQuarter);
  if (!(abs(quarters) < 1e15)) return {HUGE_VAL - HUGE_VAL, HUGE_VAL - HUGE_VAL};
  const double x = (angle - quarters * kQuarter) - quarters * kRest, q = x * x;
  double cosine = 1.0, sine = 1.0;
  for (int n = 18; n > 0; n -= 2) cosine = 1.0 - q / (n * (n - 1)) * cosine;
  for (int n = 19; n > 1; n -= 2) sine = 1.0 - q / (n * (n - 1)) * sine;
  sine *= x;
  switch (static_cast<long long>(quarters) & 3) {
    case 0: return {cosine, sine};
    case 1: return {-sine, cosine};
    case 2: return {-cosine, -sine};
    default: return {sine, -cosine};
  }
}

/// The angle [rad] of a vector, from -pi to pi; 0 for the zero vector.
inline double angle_of(double y, double x) {
  constexpr double kQuarter = 1.5707963267948966;
  const double a = abs(x), b = abs(y);
  if (!(a + b > 0.0)) return 0.0;
  // The angle to the nearer axis is halved twice, tan(t / 2) = tan t / (1 + sqrt(1 + tan^2 t)).
  double t = min(a, b) / max(a, b);
  for (int k = 0; k < 2; ++k) t = t / (1.0 + sqrt(1.0 + t * t));
  double sum = 0.0;
  for (int n = 23; n > 0; n -= 2) sum = 1.0 / n - t * t * sum;
  double angle = 4.0 * t * sum;
  if (b > a) angle = kQuarter - angle;
  if (x < 0.0) angle = 2.0 * kQuarter - angle;
  return y < 0.0 ? -angle : angle;
}

}  // namespace DLO_TARGET
}  // namespace dlo
