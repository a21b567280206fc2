// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// Rollouts on every processor of the architecture, and the targets that this processor can execute.

#define DLO_TARGET baseline
#include "rollout.hpp"

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace dlo {

#if defined(__x86_64__)

extern const Target kAvx2, kAvx512;
constexpr unsigned kAvxState = 0x6, kAvx512State = 0xe6;  // that the operating system keeps, as `xgetbv` tells

/// Whether processor and operating system support these.  (`__builtin_cpu_supports` is always false with Zig.)
static bool has(unsigned features, unsigned state) {
  unsigned a, b, c, d, low, high;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE)) return false;
  __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  return (low & state) == state && __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & features) == features;
}

#endif

const std::vector<Target>& targets() {
  static const std::vector<Target> available = [] {
    std::vector<Target> list;
#if defined(__x86_64__)
    if (has(bit_AVX2 | bit_AVX512F | bit_AVX512VL, kAvx512State)) list.push_back(kAvx512);
    if (has(bit_AVX2, kAvxState)) list.push_back(kAvx2);
#endif
    list.push_back({"baseline", baseline::roll_out});
    return list;
  }();
  return available;
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
