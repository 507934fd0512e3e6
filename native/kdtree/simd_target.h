// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace espalier {

/// The instruction set in use, as Highway's target bit: the best this machine has, or what the environment variable
/// ESPALIER_SIMD names. Throws std::runtime_error if that names none this machine runs.
int64_t simd_target();

/// Names for ESPALIER_SIMD of the sets that this machine runs: the one in use, then the others, best first.
std::vector<std::string> simd_target_names();

}  // namespace espalier

/// The address of what has this name in the namespace of the instruction set in use, for files that compile it once per
/// set.
#if defined(__x86_64__)
#define ESPALIER_OF_TARGET(name)                                         \
    (espalier::simd_target() == HWY_AVX3_DL ? &espalier::N_AVX3_DL::name \
     : espalier::simd_target() == HWY_AVX2  ? &espalier::N_AVX2::name    \
                                            : &espalier::N_SSE4::name)
#else
#define ESPALIER_OF_TARGET(name) (&espalier::N_NEON::name)
#endif
