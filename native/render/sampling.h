// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <numbers>

#include "render/matrix.h"

namespace espalier {

/// Mixes 32 bits well enough that neighbouring pixels are unrelated (Wellons, lowbias32).
constexpr uint32_t hash_bits(uint32_t x) {
    x = (x ^ (x >> 16)) * 0x7feb352dU;
    x = (x ^ (x >> 15)) * 0x846ca68bU;
    return x ^ (x >> 16);
}

constexpr uint32_t hash_bits(uint32_t a, uint32_t b) { return hash_bits(a ^ (hash_bits(b) + 0x9e3779b9U)); }

struct Sample2 {
    double x, y;  // in [0, 1)
};

/// Point `index` of the (0,2)-sequence (van der Corput, Sobol), scrambled by `seed`: any power-of-two run of points is
/// stratified in both axes, and the points depend on nothing but their arguments, which makes a picture independent of
/// scheduling.
inline Sample2 sample_2d(uint32_t index, uint32_t seed) {
    uint32_t x = 0, y = 0, sobol = 1U << 31;
    for (uint32_t i = index, bit = 1U << 31; i != 0; i >>= 1, bit >>= 1, sobol ^= sobol >> 1) {
        if (i & 1U)
            x ^= bit, y ^= sobol;
    }
    const double unit = 1.0 / 4294967296.0;
    return {(x ^ hash_bits(seed)) * unit, (y ^ hash_bits(seed ^ 0x5bd1e995U)) * unit};
}

struct SineCosine {
    double sine, cosine;
};

/// Of an angle of at most pi / 4 in size, by Taylor's series, each off by less than 1e-12. The same bits everywhere,
/// which the system's functions do not promise, and in a fraction of their time.
inline SineCosine sine_cosine(double angle) {
    const double square = angle * angle;
    double sine = 0.0;
    double cosine = 0.0;
    for (int n = 12; n > 0; n -= 2) {
        sine = (1.0 + sine) * (square * (-1.0 / (n * (n + 1))));
        cosine = (1.0 + cosine) * (square * (-1.0 / (n * (n - 1))));
    }
    return {angle + angle * sine, 1.0 + cosine};
}

/// Uniform on the unit disk; keeps strata together (Shirley and Chiu).
inline Sample2 sample_disk(Sample2 s) {
    const double a = 2.0 * s.x - 1.0, b = 2.0 * s.y - 1.0;
    if (a == 0.0 && b == 0.0)
        return {0.0, 0.0};
    const bool wide = std::abs(a) > std::abs(b);
    const double radius = wide ? a : b;
    const auto [sine, cosine] = sine_cosine((std::numbers::pi / 4.0) * (wide ? b : a) / radius);
    return {radius * (wide ? cosine : sine), radius * (wide ? sine : cosine)};
}

/// Two unit vectors that complete the unit vector `n` to an orthonormal frame (Duff et al., 2017).
struct Tangents {
    Vec3d x, y;
};
inline Tangents tangents(Vec3d n) {
    const double sign = std::copysign(1.0, n.z);
    const double a = -1.0 / (sign + n.z);
    const double b = n.x * n.y * a;
    return {{1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x}, {b, sign + n.y * n.y * a, -n.y}};
}

/// A direction about the unit vector `n` with density cos / pi.
inline Vec3d sample_cosine(Vec3d n, Sample2 s) {
    const Sample2 d = sample_disk(s);
    const Tangents t = tangents(n);
    return t.x * d.x + t.y * d.y + n * std::sqrt(std::max(0.0, 1.0 - d.x * d.x - d.y * d.y));
}

/// The point of the unit circle so many turns from (1, 0).
inline Sample2 sample_circle(double turns) {
    const double quarters = std::floor(4.0 * turns + 0.5);
    const auto [sine, cosine] = sine_cosine((std::numbers::pi / 2.0) * (4.0 * turns - quarters));
    const int quarter = static_cast<int>(quarters) & 3;
    const double x = quarter % 2 == 0 ? cosine : -sine;
    const double y = quarter % 2 == 0 ? sine : cosine;
    return quarter < 2 ? Sample2{x, y} : Sample2{-x, -y};
}

/// A direction within the cone of half angle acos(cos_half) about the unit vector `axis`, uniform over its solid angle.
inline Vec3d sample_cone(Vec3d axis, double cos_half, Sample2 s) {
    const double cos_theta = 1.0 - s.x * (1.0 - cos_half);
    const double sin_theta = std::sqrt(std::max(0.0, 1.0 - cos_theta * cos_theta));
    const Sample2 side = sample_circle(s.y);
    const Tangents t = tangents(axis);
    return axis * cos_theta + t.x * (sin_theta * side.x) + t.y * (sin_theta * side.y);
}

}  // namespace espalier
