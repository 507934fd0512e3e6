// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

namespace espalier {

/// Mixes 32 bits well enough that neighbouring pixels are unrelated (Wellons, lowbias32).
constexpr uint32_t hash_bits(uint32_t x) {
    x = (x ^ (x >> 16)) * 0x7feb352dU;
    x = (x ^ (x >> 15)) * 0x846ca68bU;
    return x ^ (x >> 16);
}

/// What a pixel's index is combined with, by an exclusive or, for the seed of its samples of this dimension:
/// hash_bits(pixel ^ dimension_key(dimension)).
constexpr uint32_t dimension_key(uint32_t dimension) { return hash_bits(dimension) + 0x9e3779b9U; }

/// The second coordinate is scrambled by another hash of the seed than the first.
constexpr uint32_t kSecondScramble = 0x5bd1e995U;

struct SequencePoint {
    uint32_t x, y;  // in units of 2^-32
};

/// Point `index` of the (0,2)-sequence (van der Corput, Sobol): any power-of-two run of points is stratified in both
/// axes.
constexpr SequencePoint sequence_point(uint32_t index) {
    uint32_t x = 0, y = 0, sobol = 1U << 31;
    for (uint32_t i = index, bit = 1U << 31; i != 0; i >>= 1, bit >>= 1, sobol ^= sobol >> 1) {
        if (i & 1U)
            x ^= bit, y ^= sobol;
    }
    return {x, y};
}

struct Sample2 {
    double x, y;  // in [0, 1)
};

/// The sequence's point scrambled by `seed`, which keeps it stratified. It depends on nothing but the arguments, which
/// makes a picture independent of scheduling.
constexpr Sample2 scrambled(SequencePoint point, uint32_t seed) {
    return {(point.x ^ hash_bits(seed)) * 0x1p-32, (point.y ^ hash_bits(seed ^ kSecondScramble)) * 0x1p-32};
}

}  // namespace espalier
