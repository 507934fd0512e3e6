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
