// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

#define DLO_AVX512
#include "avx2.cpp"
