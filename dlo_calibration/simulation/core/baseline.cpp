// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rollouts on every processor of the architecture, and the choice of the code for the one at hand.

#define DLO_TARGET baseline
#include "rollout.hpp"

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace dlo {

#if defined(__x86_64__)

extern const Target kAvx2;

/// Whether processor and operating system know AVX2.  (`__builtin_cpu_supports` is always false with Zig.)
static bool has_avx2() {
  unsigned a, b, c, d, low, high;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE)) return false;
  __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  return (low & 6) == 6 && __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & bit_AVX2);
}

#endif

const std::vector<Target>& targets() {
  static const std::vector<Target> found = [] {
    std::vector<Target> list;
#if defined(__x86_64__)
    if (has_avx2()) list.push_back(kAvx2);
#endif
    list.push_back({"baseline", baseline::roll_out});
    return list;
  }();
  return found;
}

Outcome follow(const Script& script, Rope& rope, const std::function<void()>& step) {
  Outcome outcome;
  baseline::Rollout rollout(script, rope, outcome);
  while (rollout.next()) do {
    rollout.aim();
    step();
  } while (!rollout.arrive(rope.rods, 0));
  return outcome;
}

}  // namespace dlo
