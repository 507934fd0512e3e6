// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <random>

#include "geometry/vec.h"

namespace espalier {

/// The same numbers in each run.
class UniformRandom {
 public:
    double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(engine_); }
    bool happens(double share) { return uniform(0, 1) < share; }
    Vec3d point(double size) { return {uniform(-size, size), uniform(-size, size), uniform(-size, size)}; }

 private:
    std::mt19937 engine_{12345};
};

}  // namespace espalier
