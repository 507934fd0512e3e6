// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <gmpxx.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <random>
#include <string>
#include <vector>

#include "geometry/triangle.h"
#include "geometry/vec.h"

namespace espalier {

using Exact = mpq_class;
using ExactVec = std::array<Exact, 3>;

inline ExactVec exact(Vec3f a) { return {Exact(a.x), Exact(a.y), Exact(a.z)}; }
inline ExactVec minus(const ExactVec& a, const ExactVec& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Exact dot(const ExactVec& a, const ExactVec& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline ExactVec cross(const ExactVec& a, const ExactVec& b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
inline Exact size_of(const Exact& a) { return abs(a); }

/// The largest share of its bound that an error took up.
class Share {
 public:
    explicit Share(std::string name) : name_(std::move(name)) {}
    ~Share() { std::printf("[  share   ] %-44s %.3f of the bound at most\n", name_.c_str(), largest_); }
    Share(const Share&) = delete;
    Share& operator=(const Share&) = delete;

    void add(const Exact& error, const Exact& bound) {
        if (error != 0) {
            largest_ = std::max(largest_, bound > 0 ? Exact(size_of(error) / bound).get_d() : HUGE_VAL);
        }
    }
    double largest() const { return largest_; }

 private:
    std::string name_;
    double largest_ = 0;
};

/// Floats whose last bits are extreme as often as not, which is where roundings add up.
class Random {
 public:
    explicit Random(uint32_t seed) : engine_(seed) {}

    uint32_t below(uint32_t count) { return static_cast<uint32_t>(engine_()) % count; }
    /// In [1, 2).
    float mantissa() {
        const uint32_t few = below(16);
        switch (below(4)) {
            case 0:
                return 1 + static_cast<float>(few) * 0x1p-23F;
            case 1:
                return 2 - static_cast<float>(few + 1) * 0x1p-23F;
            default:
                return 1 + static_cast<float>(below(1U << 23)) * 0x1p-23F;
        }
    }
    /// Of either sign and between 2^low and 2^(high + 1).
    float number(int low, int high) {
        const int exponent = low + static_cast<int>(below(static_cast<uint32_t>(high - low + 1)));
        return std::ldexp(below(2) == 0 ? mantissa() : -mantissa(), exponent);
    }
    Vec3f point(int low, int high) {
        const float x = number(low, high);
        const float y = number(low, high);
        return {x, y, number(low, high)};
    }
    /// In [0, 1].
    float fraction() { return static_cast<float>(below((1U << 24) + 1)) * 0x1p-24F; }

 private:
    std::mt19937 engine_;
};

/// Ranges of coordinates, as exponents of two: about one, wide, small, and the ends of what is allowed.
constexpr int kRanges[][2] = {{-1, 0}, {-20, 20}, {-140, -120}, {-60, -40}, {50, 59}};

inline bool has_area(const Vec3f (&corner)[3]) {
    return classify_face(corner[0], corner[1], corner[2]) == FaceFault::kNone;
}

}  // namespace espalier
