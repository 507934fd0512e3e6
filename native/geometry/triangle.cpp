// SPDX-License-Identifier: GPL-3.0-or-later
#include "geometry/triangle.h"

#include <array>

namespace espalier {
namespace {

/// True when a + b + … of the six terms is exactly zero. Each term is an exact double; the sum is kept as a
/// nonoverlapping expansion (Shewchuk 1997, GROW-EXPANSION), whose value is zero only if all its parts are.
bool sum_is_zero(const std::array<double, 6>& terms) {
    std::array<double, 6> expansion{};
    for (size_t count = 0; count < terms.size(); ++count) {
        double carry = terms[count];
        for (size_t i = 0; i < count; ++i) {  // TWO-SUM (Knuth): part + carry = sum + error, exactly
            const double part = expansion[i];
            const double sum = part + carry;
            const double virtual_carry = sum - part;
            expansion[i] = (part - (sum - virtual_carry)) + (carry - virtual_carry);
            carry = sum;
        }
        expansion[count] = carry;
    }
    for (const double part : expansion) {
        if (part != 0.0) {
            return false;
        }
    }
    return true;
}

/// True when the points a, b, c of a plane lie on one line. Products of two floats are exact in double.
bool is_collinear(double ax, double ay, double bx, double by, double cx, double cy) {
    return sum_is_zero({ax * by, -(ax * cy), -(cx * by), -(ay * bx), ay * cx, cy * bx});
}

}  // namespace

FaceFault classify_face(Vec3f v0, Vec3f v1, Vec3f v2) {
    if (!is_finite(v0) || !is_finite(v1) || !is_finite(v2)) {
        return FaceFault::kNotFinite;
    }
    for (const Vec3f& v : {v0, v1, v2}) {
        if (largest_of(v) > kMaxCoordinate) {
            return FaceFault::kTooLarge;
        }
    }
    for (int axis = 0; axis < 3; ++axis) {
        const int x = (axis + 1) % 3;
        const int y = (axis + 2) % 3;
        if (!is_collinear(v0[x], v0[y], v1[x], v1[y], v2[x], v2[y])) {
            return FaceFault::kNone;
        }
    }
    return FaceFault::kNoArea;
}

}  // namespace espalier
