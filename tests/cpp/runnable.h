// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <iterator>
#include <string>
#include <vector>

#include "kdtree/simd_target.h"

/// A list of make(name, namespace) for each instruction set that code is compiled for.
#if defined(__x86_64__)
#define ESPALIER_FOR_EACH_SET(make) make("sse4", N_SSE4), make("avx2", N_AVX2), make("avx512", N_AVX3_DL)
#else
#define ESPALIER_FOR_EACH_SET(make) make("neon", N_NEON)
#endif

namespace espalier {

/// Of code for several instruction sets, that which this machine runs.
template <class Code>
std::vector<Code> runnable(const std::vector<Code>& all) {
    const std::vector<std::string> names = simd_target_names();
    std::vector<Code> found;
    std::copy_if(all.begin(), all.end(), std::back_inserter(found),
                 [&](const Code& code) { return std::find(names.begin(), names.end(), code.name) != names.end(); });
    return found;
}

}  // namespace espalier
