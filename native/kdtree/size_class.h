// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>

#include "geometry/vec.h"

namespace espalier {

/// How large triangles are at most, in sixteen powers of two: of class c, no side of a triangle's box is as long as
/// limit(c). limit(0) is the least power of two above the sides of all triangles' bounds, or 2^-110 where those are
/// tiny, and no limit lies below 2^-125. It tells rays how exactly they have to look.
class SizeClasses {
 public:
    static constexpr uint32_t kCount = 16;

    SizeClasses() = default;
    /// bounds: of all triangles.
    explicit SizeClasses(const Box3f& bounds) {
        if (!bounds.is_empty()) {
            const Vec3f size = bounds.size();
            top_ = std::max(exponent(std::max({size.x, size.y, size.z})), kCount);
        }
    }

    /// longest_side: of a triangle within the bounds.
    uint32_t of(float longest_side) const { return std::min(top_ - exponent(longest_side), kCount - 1); }
    float limit(uint32_t size_class) const { return std::bit_cast<float>((top_ + 1 - size_class) << kMantissaBits); }

 private:
    static constexpr uint32_t kMantissaBits = 23;
    /// Of a number that is not negative, with what floats add to it.
    static uint32_t exponent(float size) { return std::bit_cast<uint32_t>(size) >> kMantissaBits; }

    uint32_t top_ = kCount;
};

}  // namespace espalier
