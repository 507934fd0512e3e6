// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <limits>

#include "geometry/triangle.h"

namespace espalier {
namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

TEST(ClassifyFace, NamesTheFault) {
    const Vec3f a{0, 0, 0};
    const Vec3f b{1, 0, 0};
    EXPECT_EQ(classify_face(a, b, {0, 1, 0}), FaceFault::kNone);
    EXPECT_EQ(classify_face(a, b, {0, kNan, 0}), FaceFault::kNotFinite);
    EXPECT_EQ(classify_face(a, b, {0, 0, -std::numeric_limits<float>::infinity()}), FaceFault::kNotFinite);
    EXPECT_EQ(classify_face(a, b, {0, 2 * kMaxCoordinate, 0}), FaceFault::kTooLarge);
    EXPECT_EQ(classify_face(a, b, {0, kMaxCoordinate, 0}), FaceFault::kNone);
    EXPECT_EQ(classify_face(a, a, b), FaceFault::kNoArea);
    EXPECT_EQ(classify_face(a, b, {5, 0, 0}), FaceFault::kNoArea);
}

TEST(ClassifyFace, DecidesAreaExactly) {
    // On one line to the last bit, with differences that are not floats.
    const float third = 1.0F / 3.0F;
    EXPECT_EQ(classify_face({third, third, third}, {2 * third, 2 * third, 2 * third}, {1e10F, 1e10F, 1e10F}),
              FaceFault::kNoArea);
    // The same along a slope, so that the differences' errors do not cancel.
    const float step = 0x155555p-24F;
    EXPECT_EQ(classify_face({step, 7 * step, 0}, {4 * step, 28 * step, 0}, {0x1p34F * step, 0x7p34F * step, 0}),
              FaceFault::kNoArea);
    // One ulp beside it, far from the origin.
    const float x = 16777216.0F;
    EXPECT_EQ(classify_face({x, x, 0}, {x + 2, x + 2, 0}, {2 * x, 2 * x, 0}), FaceFault::kNoArea);
    EXPECT_EQ(classify_face({x, x, 0}, {x + 2, x + 2, 0}, {2 * x, 2 * x + 4, 0}), FaceFault::kNone);
    // Areas far below the smallest float are areas.
    const float tiny = std::numeric_limits<float>::denorm_min();
    EXPECT_EQ(classify_face({0, 0, 0}, {tiny, 0, 0}, {0, tiny, 0}), FaceFault::kNone);
    EXPECT_EQ(classify_face({0, 0, 0}, {tiny, tiny, 0}, {3 * tiny, 3 * tiny, 0}), FaceFault::kNoArea);
    // Terms of very different size that cancel only in part.
    EXPECT_EQ(classify_face({kMaxCoordinate, 0, 0}, {0, tiny, 0}, {-kMaxCoordinate, 0, 0}), FaceFault::kNone);
}

}  // namespace
}  // namespace espalier
