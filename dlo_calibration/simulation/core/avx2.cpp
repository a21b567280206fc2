// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0
// The same rollouts for processors with AVX2, which compute four numbers per instruction, and once more, by
// `avx512.cpp`, for those with AVX-512VL, which have twice as many registers.  The standard library's headers
// come before the pragma: what they define must run on every processor.

#if defined(__x86_64__)

#include <algorithm>
#include <cmath>
#include <memory>
#include <type_traits>

#include "script.hpp"

#ifdef DLO_AVX512
#define DLO_TARGET avx512
#define DLO_FEATURES "avx2,avx512f,avx512vl"
#else
#define DLO_TARGET avx2
#define DLO_FEATURES "avx2"
#endif
#define DLO_PRAGMA(text) _Pragma(#text)
#define DLO_EXPANDED(text) DLO_PRAGMA(text)
#ifdef __clang__
DLO_EXPANDED(clang attribute push(__attribute__((target(DLO_FEATURES))), apply_to = function))
#else
#pragma GCC push_options
DLO_EXPANDED(GCC target(DLO_FEATURES, "prefer-vector-width=256"))
#endif

#define DLO_AVX2
#include "rollout.hpp"

#ifdef __clang__
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

namespace dlo {

#ifdef DLO_AVX512
extern const Target kAvx512;
const Target kAvx512 = {"avx512", avx512::roll_out};
#else
extern const Target kAvx2;
const Target kAvx2 = {"avx2", avx2::roll_out};
#endif

}  // namespace dlo

#endif
