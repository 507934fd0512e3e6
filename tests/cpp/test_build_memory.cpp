// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <vector>

#include "kdtree/large_buffer.h"
#include "kdtree/parallel.h"
#include "kdtree/subtree_output.h"

namespace espalier {
namespace {

/// Buffers of one memory, taken by all threads, too many and too large for it: each keeps what was written to it.
TEST(TransientMemory, GivesEachBufferRoomOfItsOwn) {
    constexpr size_t kBuffers = 200;
    const auto size_of = [](size_t i) { return i % 50 == 7 ? size_t{1} << 20 : 150'000 + 7 * i; };
    TransientMemory memory(5'000'000);
    std::vector<LargeBuffer<uint32_t>> buffers(kBuffers);
    std::atomic<size_t> not_zero{0};
    parallel_for(4, kBuffers, [&](size_t i) {
        buffers[i] = memory.take<uint32_t>(size_of(i));
        not_zero += static_cast<size_t>(
            std::count_if(buffers[i].span().begin(), buffers[i].span().end(), [](uint32_t item) { return item != 0; }));
        std::fill_n(buffers[i].data(), buffers[i].size(), static_cast<uint32_t>(i + 1));
    });
    EXPECT_EQ(not_zero, 0U);
    for (size_t i = 0; i < kBuffers; ++i) {
        EXPECT_EQ(buffers[i].size(), size_of(i));
        EXPECT_EQ(static_cast<size_t>(
                      std::count(buffers[i].span().begin(), buffers[i].span().end(), static_cast<uint32_t>(i + 1))),
                  buffers[i].size());
    }
}

TEST(TransientMemory, TakesNoMoreThanItHas) {
    TransientMemory memory(0);
    std::vector<LargeBuffer<std::byte>> buffers;
    for (int i = 0; i < 20; ++i) {
        buffers.push_back(memory.take<std::byte>(size_t{30} << 20));
        buffers.back()[0] = buffers.back()[buffers.back().size() - 1] = std::byte(i);
    }
    for (size_t i = 0; i < buffers.size(); ++i) {
        EXPECT_EQ(buffers[i][0], std::byte(i));
        EXPECT_EQ(buffers[i][buffers[i].size() - 1], std::byte(i));
    }
}

/// Many inner nodes of two leaves each, one of them in part of a block and one in several.
TEST(SubtreeOutput, KeepsWhatItHoldsAsItGrows) {
    constexpr uint32_t kInner = 3000;
    const auto box_of = [](uint32_t i) {
        const auto at = static_cast<float>(i);
        return Box3f{{at, at, at}, {at + 1, at + 1, at + 1}};
    };
    TransientMemory memory(0);
    SubtreeOutput output(100, &memory);
    for (uint32_t i = 0; i < kInner; ++i) {
        const size_t inner = output.open_inner();
        output.add_leaf(std::vector<uint32_t>{i, i + 1, i + 2}, box_of(i));
        const size_t right = output.node_count();
        output.add_leaf(std::vector<uint32_t>(20, i), box_of(i + 1));
        output.close_inner(inner, {1, static_cast<float>(i)}, right);
    }
    ASSERT_EQ(output.node_count(), size_t{3} * kInner);
    ASSERT_EQ(output.triangle_count(), size_t{4} * kBlockSize * kInner);
    const TreePiece whole = output.whole();
    for (uint32_t i = 0; i < kInner; ++i) {
        const KdNode* node = &output.nodes()[size_t{3} * i];
        ASSERT_FALSE(node[0].is_leaf());
        ASSERT_EQ(node[0].right_child(), 3 * i + 2);
        ASSERT_EQ(node[0].split(), static_cast<float>(i));
        ASSERT_EQ(node[1].references(), 3U);
        ASSERT_EQ(node[2].references(), 20U);
        const uint32_t* triangles = &whole.triangles[size_t{4} * kBlockSize * i];
        ASSERT_EQ(node[2].first_block(), 4 * i + 1);
        ASSERT_EQ(triangles[2], i + 2);
        ASSERT_EQ(triangles[3], kNoTriangle);
        ASSERT_EQ(std::count(triangles + kBlockSize, triangles + 4 * kBlockSize, i), 20);
        ASSERT_EQ(whole.box(3 * i).lower.x, static_cast<float>(i));
        ASSERT_EQ(whole.box(3 * i).upper.x, static_cast<float>(i + 2));
        ASSERT_EQ(whole.part_box(4 * i + 3).lower.y, static_cast<float>(i + 1));
    }
}

}  // namespace
}  // namespace espalier
