// SPDX-License-Identifier: GPL-3.0-or-later
// How a leaf's references are arranged, on each instruction set.
#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <set>
#include <string>
#include <vector>

#include "kdtree/simd_config.h"
#include "runnable.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "test_leaf_parts.cpp"
#include <hwy/foreach_target.h>
// Highway's own header has to follow foreach_target.h.
#include <hwy/highway.h>

#include "kdtree/leaf_parts-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {

inline void write_leaf(const References& references, const OpenNode& node, SubtreeOutput& output) {
    LeafParts<4>(references, node, true).write(Members<4>::first(node.count), node.count, node.tight, output);
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace espalier {
namespace {

struct Code {
    const char* name;
    void (*write_leaf)(const References&, const OpenNode&, SubtreeOutput&);
};

std::vector<Code> code_under_test() {
#define ESPALIER_CODE(name, set) \
    {                            \
        name, set::write_leaf    \
    }
    return runnable<Code>({ESPALIER_FOR_EACH_SET(ESPALIER_CODE)});
#undef ESPALIER_CODE
}

/// A node that is to become a leaf, and the leaf.
class Leaf {
 public:
    explicit Leaf(const std::vector<Box3f>& boxes) : boxes_(boxes), references_(boxes.size()), output_(1024) {
        const References& references = references_.references();
        for (size_t i = 0; i < boxes.size(); ++i) {
            for (int axis = 0; axis < 3; ++axis) {
                references.lower[static_cast<size_t>(axis)][i] = boxes[i].lower[axis];
                references.upper[static_cast<size_t>(axis)][i] = boxes[i].upper[axis];
            }
            references.triangle[i] = 1000 + static_cast<uint32_t>(i);
            node_.tight.extend(boxes[i]);
        }
        node_.cell = node_.tight;
        node_.count = static_cast<uint32_t>(boxes.size());
    }

    void write(const Code& code) { code.write_leaf(references_.references(), node_, output_); }

    uint32_t count() const { return node_.count; }
    const Box3f& tight() const { return node_.tight; }
    TreePiece piece() const { return output_.whole(); }
    /// Of those in so many blocks.
    Box3f box_of(uint32_t first_block, uint32_t blocks) const {
        Box3f box;
        for (uint32_t i = first_block * kBlockSize; i < std::min((first_block + blocks) * kBlockSize, count()); ++i) {
            box.extend(boxes_[piece().triangles[i] - 1000]);
        }
        return box;
    }

 private:
    std::vector<Box3f> boxes_;
    ReferenceBuffer references_;
    OpenNode node_{{}, {}, 0, 0, 0};
    SubtreeOutput output_;
};

/// Each part's box holds what lies in its blocks and nothing else.
void expect_tight_parts(const Leaf& leaf, uint32_t first_block, uint32_t blocks, uint32_t part) {
    if (blocks <= 2) {
        return;
    }
    const uint32_t first = first_blocks(blocks);
    const uint32_t second = part + 1 + part_count(first);
    EXPECT_EQ(leaf.piece().part_box(part), leaf.box_of(first_block, first));
    EXPECT_EQ(leaf.piece().part_box(second), leaf.box_of(first_block + first, blocks - first));
    expect_tight_parts(leaf, first_block, first, part + 1);
    expect_tight_parts(leaf, first_block + first, blocks - first, second + 1);
}

constexpr uint32_t kCounts[] = {1, 7, 8, 16, 17, 24, 31, 32, 33, 63, 64, 65, 100, 127, 128, 129, 200, 255, 256};

class LeafPartsTest : public testing::TestWithParam<Code> {};

TEST_P(LeafPartsTest, HoldAllReferencesInTightBoxes) {
    std::mt19937 engine(5);
    for (const uint32_t count : kCounts) {
        for (const float scale : {1.0F, 0x1p-100F, 0x1p60F}) {
            const auto at = [&] { return std::uniform_real_distribution<float>(-1, 1)(engine) * scale; };
            std::vector<Box3f> boxes(count);
            for (Box3f& box : boxes) {
                box.extend(Vec3f{at(), at(), at()});
                box.extend(Vec3f{at(), at(), at()});
            }
            Leaf leaf(boxes);
            leaf.write(GetParam());
            const std::span<const uint32_t> triangles = leaf.piece().triangles;
            ASSERT_EQ(triangles.size(), block_count(count) * kBlockSize);
            const std::set<uint32_t> distinct(triangles.begin(), triangles.begin() + count);
            EXPECT_EQ(distinct.size(), count);
            EXPECT_EQ(*distinct.begin(), 1000U);
            EXPECT_EQ(*distinct.rbegin(), 999 + count);
            EXPECT_TRUE(std::all_of(triangles.begin() + count, triangles.end(),
                                    [](uint32_t triangle) { return triangle == kNoTriangle; }));
            EXPECT_EQ(leaf.piece().box(0), leaf.tight());
            expect_tight_parts(leaf, 0, block_count(count), 0);
        }
    }
}

/// Strips as long as the leaf, stacked along a short side, in an order in which neighbours lie apart; along the other
/// sides all have one middle.
TEST_P(LeafPartsTest, AreHalvedWhereBoxesBecomeSmallest) {
    for (const uint32_t count : kCounts) {
        for (int axis = 0; axis < 3; ++axis) {
            for (const float scale : {1.0F, 0x1p-80F, 0x1p55F}) {
                std::vector<Box3f> boxes(count);
                for (uint32_t i = 0; i < count; ++i) {
                    const float low = static_cast<float>(i * 37 % count) / static_cast<float>(count);
                    Box3f& box = boxes[i];
                    for (int a = 0; a < 3; ++a) {
                        box.lower[a] = scale * (a == axis ? low : 0);
                        box.upper[a] = scale * (a == axis ? low + 0x1p-10F : 8);
                    }
                }
                Leaf leaf(boxes);
                leaf.write(GetParam());
                const uint32_t blocks = block_count(count);
                if (blocks <= 2 || count > 64) {  // steps are a sixty-fourth of the leaf
                    continue;
                }
                const uint32_t first = first_blocks(blocks);
                const Box3f low = leaf.box_of(0, first);
                const Box3f high = leaf.box_of(first, blocks - first);
                EXPECT_LT(low.upper[axis], high.lower[axis]) << count << ' ' << axis << ' ' << scale;
            }
        }
    }
}

INSTANTIATE_TEST_SUITE_P(Sets, LeafPartsTest, testing::ValuesIn(code_under_test()),
                         [](const auto& info) { return std::string(info.param.name); });

}  // namespace
}  // namespace espalier
#endif
