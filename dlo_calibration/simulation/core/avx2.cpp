// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// The same rollouts for processors with AVX2, which compute four numbers in one instruction.  The standard
// library's headers come before the pragma: what they define must run on every processor.

#if defined(__x86_64__)

#include <algorithm>
#include <cmath>
#include <memory>
#include <type_traits>

#include "script.hpp"

#ifdef __clang__
#pragma clang attribute push(__attribute__((target("avx2"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2")
#endif

#define DLO_TARGET avx2
#define DLO_AVX2
#include "rollout.hpp"

#ifdef __clang__
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

namespace dlo {

extern const Target kAvx2;
const Target kAvx2 = {"avx2", avx2::roll_out};

}  // namespace dlo

#endif
