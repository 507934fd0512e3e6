// SPDX-License-Identifier: GPL-3.0-or-later
// The builder's inequalities of native/EXACTNESS.md, measured against rational arithmetic: on each instruction set the
// largest error, as a share of its bound, has to stay below 1, and to come near enough that a wrong bound would be
// seen.
#include <gtest/gtest.h>

#include "exact_kit.h"
#include "kdtree/simd_config.h"
#include "runnable.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "test_build_bounds.cpp"
#include <hwy/foreach_target.h>
// Highway's own header has to follow foreach_target.h.
#include <hwy/highway.h>

#include "kdtree/bounds-inl.h"
#include "kdtree/partition-inl.h"
#include "kdtree/slices-inl.h"

#ifndef ESPALIER_TEST_BUILD_BOUNDS_TYPES
#define ESPALIER_TEST_BUILD_BOUNDS_TYPES
namespace espalier {

/// What the code under test computes for one case.
struct AreaResult {
    float value, bound;
};
struct CrossingResult {
    float low, high;
};
struct SlicesResult {
    float position[16];
    int8_t begin, end;
    float reach;
};

}  // namespace espalier
#endif

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

inline AreaResult area_of(const Vec3f (&corner)[3], int axis) {
    const hn::ScalableTag<float> d;
    using V = hn::Vec<decltype(d)>;
    V v[3][3];
    for (int k = 0; k < 3; ++k) {
        for (int a = 0; a < 3; ++a) {
            v[k][a] = hn::Set(d, corner[k][a]);
        }
    }
    V value;
    V bound;
    cross_component(d, v, axis, value, bound);
    return {hn::GetLane(value), hn::GetLane(bound)};
}

inline CrossingResult crossing_of(float plane, float pa, float qa, float pb, float qb) {
    const hn::ScalableTag<float> d;
    using V = hn::Vec<decltype(d)>;
    const V t = hn::Div(hn::Sub(hn::Set(d, plane), hn::Set(d, pa)), hn::Sub(hn::Set(d, qa), hn::Set(d, pa)));
    V low;
    V high;
    cross_plane(d, t, hn::Set(d, pb), hn::Set(d, qb), low, high);
    return {hn::GetLane(low), hn::GetLane(high)};
}

/// The planes between slices, and where a box between `low` and `high` is counted.
inline SlicesResult slices_of(float lower, float upper, float low, float high) {
    const hn::CappedTag<float, 16> d;
    SlicesResult result;
    for (int j = 0; j < 16; j += static_cast<int>(hn::Lanes(d))) {
        hn::StoreU(slice_positions(d, lower, upper, j), d, result.position + j);
    }
    std::vector<float> lows(64, low);
    std::vector<float> highs(64, high);
    quantise<true>(d, lows.data(), highs.data(), Slices(lower, upper), kSlices, 1,
                   [&](uint32_t first, const auto begin, const auto end) {
                       if (first == 0) {
                           result.begin = hn::GetLane(begin);
                           result.end = hn::GetLane(end);
                       }
                   });
    result.reach = reach_beyond_slices(lower, upper);
    return result;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace espalier {
namespace {

struct Code {
    const char* name;
    AreaResult (*area_of)(const Vec3f (&)[3], int);
    CrossingResult (*crossing_of)(float, float, float, float, float);
    SlicesResult (*slices_of)(float, float, float, float);
};

std::vector<Code> code_under_test() {
#define ESPALIER_CODE(name, set)                             \
    {                                                        \
        name, set::area_of, set::crossing_of, set::slices_of \
    }
    return runnable<Code>({ESPALIER_FOR_EACH_SET(ESPALIER_CODE)});
#undef ESPALIER_CODE
}

class BuildBounds : public testing::TestWithParam<Code> {
 protected:
    static std::string named(const std::string& what) { return std::string(GetParam().name) + ": " + what; }
};

TEST_P(BuildBounds, OfTheCrossProductDecideArea) {
    Random random(1);
    Share share(named("cross product, 3"));
    for (const auto& [low, high] : kRanges) {
        for (int i = 0; i < 4000; ++i) {
            Vec3f corner[3] = {random.point(low, high), random.point(low, high), random.point(low, high)};
            if (random.below(2) == 0) {  // nearly on one line
                corner[2] = corner[0] + (corner[1] - corner[0]) * random.fraction();
            }
            const ExactVec normal =
                cross(minus(exact(corner[1]), exact(corner[0])), minus(exact(corner[2]), exact(corner[0])));
            for (int axis = 0; axis < 3; ++axis) {
                const AreaResult result = GetParam().area_of(corner, axis);
                share.add(Exact(result.value) - normal[static_cast<size_t>(axis)], result.bound);
            }
            EXPECT_EQ(has_area(corner), normal[0] != 0 || normal[1] != 0 || normal[2] != 0);
        }
    }
    EXPECT_LT(share.largest(), 1);
    EXPECT_GT(share.largest(), 0.2);
}

TEST_P(BuildBounds, OfCrossingsHoldTheTrueOne) {
    Random random(2);
    Share share(named("crossing of edge and plane, 4"));
    for (const auto& [low, high] : kRanges) {
        for (int i = 0; i < 20000; ++i) {
            const float pa = random.number(low, high);
            const float qa = random.below(4) == 0 ? pa * (1 + 0x1p-20F) : random.number(low, high);
            const float plane = pa + (qa - pa) * random.fraction();
            if (!(std::min(pa, qa) < plane && plane < std::max(pa, qa))) {
                continue;
            }
            const float pb = random.number(low, high);
            const float qb = random.below(4) == 0 ? pb * (1 - 0x1p-18F) : random.number(low, high);
            const CrossingResult result = GetParam().crossing_of(plane, pa, qa, pb, qb);
            const Exact crossing = pb + (Exact(qb) - pb) * (Exact(plane) - pa) / (Exact(qa) - pa);
            const Exact middle = (Exact(result.low) + result.high) / 2;
            share.add(crossing - middle, (Exact(result.high) - result.low) / 2);
        }
    }
    EXPECT_LT(share.largest(), 1);
    EXPECT_GT(share.largest(), 0.2);
}

TEST_P(BuildBounds, OfSlicesHoldWhatIsCountedOnOneSide) {
    Random random(3);
    Share share(named("box beyond a plane between slices, 5"));
    for (const auto& [low, high] : kRanges) {
        for (int i = 0; i < 3000; ++i) {
            float lower = random.number(low, high);
            float upper = random.below(2) == 0 ? lower + std::abs(lower) * random.fraction() * 0x1p-10F
                                               : random.number(low, high);
            if (lower > upper) {
                std::swap(lower, upper);
            }
            if (!(upper - lower > 0x1p-96F)) {
                continue;
            }
            // A point beside a plane, as a box.
            const int plane = 1 + static_cast<int>(random.below(14));
            float x = GetParam().slices_of(lower, upper, lower, upper).position[plane];
            for (uint32_t steps = random.below(12); steps != 0; --steps) {
                x = std::nextafter(x, (i & 1) != 0 ? HUGE_VALF : -HUGE_VALF);
            }
            x = std::clamp(x, lower, upper);
            const SlicesResult result = GetParam().slices_of(lower, upper, x, x);
            for (int j = 0; j < 15; ++j) {
                const bool goes_left = result.begin < j;
                const bool goes_right = result.end > j - 1;
                EXPECT_TRUE(goes_left || goes_right);
                const Exact beyond = Exact(x) - result.position[j];
                if (!goes_right && beyond > 0) {
                    share.add(beyond, result.reach);
                    EXPECT_LE(x, result.position[j] + result.reach);
                }
                if (!goes_left && beyond < 0) {
                    share.add(beyond, result.reach);
                    EXPECT_GE(x, result.position[j] - result.reach);
                }
            }
        }
    }
    EXPECT_LT(share.largest(), 1);
    EXPECT_GT(share.largest(), 0.05);
}

INSTANTIATE_TEST_SUITE_P(OnEachSet, BuildBounds, testing::ValuesIn(code_under_test()),
                         [](const auto& code) { return std::string(code.param.name); });

}  // namespace
}  // namespace espalier
#endif
