// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/simd_target.h"

#include <cstdlib>
#include <stdexcept>

#include "kdtree/simd_config.h"

namespace espalier {
namespace {

struct NamedTarget {
    const char* name;
    int64_t bit;
};

std::vector<NamedTarget> runnable_targets() {
    std::vector<NamedTarget> targets;
#if defined(__x86_64__)
    __builtin_cpu_init();
    // Ice Lake's set and later, among them all of Zen 4 and 5: vector population counts are what the builder wants
    // most.
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512vpopcntdq") && __builtin_cpu_supports("avx512bitalg") &&
        __builtin_cpu_supports("avx512vbmi2") && __builtin_cpu_supports("avx512vbmi") &&
        __builtin_cpu_supports("avx512vnni") && __builtin_cpu_supports("vpclmulqdq") &&
        __builtin_cpu_supports("gfni")) {
        targets.push_back({"avx512", HWY_AVX3_DL});
    }
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) {
        targets.push_back({"avx2", HWY_AVX2});
    }
    targets.push_back({"sse4", HWY_SSE4});
#elif defined(__aarch64__)
    targets.push_back({"neon", HWY_NEON});
#endif
    return targets;
}

int64_t choose_target() {
    const std::vector<NamedTarget> targets = runnable_targets();
    const char* wanted = std::getenv("ESPALIER_SIMD");
    if (wanted == nullptr || *wanted == '\0') {
        return targets.front().bit;
    }
    std::string names;
    for (const NamedTarget& target : targets) {
        if (target.name == std::string(wanted)) {
            return target.bit;
        }
        names += std::string(names.empty() ? "" : ", ") + target.name;
    }
    throw std::runtime_error("ESPALIER_SIMD=" + std::string(wanted) + ": this machine runs " + names);
}

}  // namespace

int64_t simd_target() {
    static const int64_t chosen = choose_target();
    return chosen;
}

std::vector<std::string> simd_target_names() {
    std::vector<std::string> names;
    for (const NamedTarget& target : runnable_targets()) {
        names.insert(target.bit == simd_target() ? names.begin() : names.end(), target.name);
    }
    return names;
}

}  // namespace espalier
