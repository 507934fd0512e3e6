// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

#include "geometry/expansion.h"

namespace espalier {
namespace {

TEST(Expansion, KeepsWhatDoublesLose) {
    const Expansion big(0x1p200);
    const Expansion tiny(0x1p-200);
    EXPECT_EQ(((big + tiny) - big - tiny).sign(), 0);
    EXPECT_EQ((big + tiny - big).estimate(), 0x1p-200);
    EXPECT_EQ(((big + tiny) * (big - tiny) - big * big + tiny * tiny).sign(), 0);
    EXPECT_EQ((Expansion(0.1) * Expansion(0.1) - Expansion(0.1 * 0.1)).sign(), -1) << "0.1 * 0.1 is rounded up";
    EXPECT_EQ(Expansion().sign(), 0);
    EXPECT_EQ(Expansion::difference(1, 0x1p-100).estimate(), 1);
    EXPECT_EQ((Expansion::difference(1, 0x1p-100) - Expansion(1)).estimate(), -0x1p-100);
}

/// Sums of many numbers of very different size: more parts than there is room for, unless they are compressed.
TEST(Expansion, CompressesWhenItRunsOutOfRoom) {
    std::mt19937 random(5);
    std::vector<double> numbers;
    Expansion sum;
    for (int i = 0; i < 2000; ++i) {
        numbers.push_back(std::ldexp(1.0 + i * 0x1p-12, static_cast<int>(random() % 1800) - 900));
        sum = sum + Expansion(numbers.back());
    }
    EXPECT_GT(sum.sign(), 0);
    std::shuffle(numbers.begin(), numbers.end(), random);
    for (const double number : numbers) {
        sum = sum - Expansion(number);
    }
    EXPECT_EQ(sum.sign(), 0) << "what was added has been taken away to the last bit";

    // Every third bit, each in a part of its own: pushed out of a part by a larger number that is taken away again.
    const auto bit = [](int i) { return std::ldexp(1.0, 3 * i - 600); };
    for (int i = 0; i < 300; ++i) {
        const double above = bit(i) * 0x1p52;
        const double far = bit(i) * 0x1p60;
        sum = sum + Expansion(bit(i) + above) + Expansion(far) - Expansion(far + above);
    }
    for (int i = 0; i < 300; ++i) {
        EXPECT_EQ(sum.sign(), 1);
        sum = sum - Expansion(bit(i));
    }
    EXPECT_EQ(sum.sign(), 0);
}

TEST(Expansion, MultipliesOut) {
    std::mt19937 random(6);
    const auto number = [&] {
        return Expansion::difference(static_cast<double>(random()), static_cast<double>(random()) * 0x1p-70);
    };
    for (int i = 0; i < 200; ++i) {
        const Expansion a = number();
        const Expansion b = number();
        const Expansion c = number();
        const Expansion d = number();
        EXPECT_EQ(((a + b) * (c - d) - (a * c - a * d + b * c - b * d)).sign(), 0);
    }
}

}  // namespace
}  // namespace espalier
