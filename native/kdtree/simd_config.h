// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

// Include this before any Highway header: it says which instruction sets the kernels are compiled for.
#define HWY_WANT_AVX3_DL
#if defined(__x86_64__)
#define HWY_BASELINE_TARGETS HWY_SSE4
// Only one flavour of AVX-512: lower bits are the later ones, which gain nothing here.
#define HWY_DISABLED_TARGETS ((HWY_AVX3_DL - 1) | HWY_AVX3)
#elif defined(__aarch64__)
// Vectors of a length known when compiling: no SVE.
#define HWY_DISABLED_TARGETS (HWY_NEON - 1)
#endif

#include <hwy/detect_targets.h>
