// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>
#include <sys/mman.h>

#include <algorithm>
#include <atomic>
#include <numeric>
#include <optional>
#include <vector>

#include "kdtree/large_buffer.h"
#include "kdtree/parallel.h"
#include "kdtree/subtree_output.h"

namespace espalier {
namespace {

/// Buffers of one memory, taken by all threads, too many and too large for it: each keeps what was written to it.
TEST(BuildMemory, GivesEachBufferRoomOfItsOwn) {
    constexpr size_t kBuffers = 200;
    const auto size_of = [](size_t i) { return i % 50 == 7 ? size_t{1} << 20 : 150'000 + 7 * i; };
    BuildMemory memory({0, 0}, 5'000'000);
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

TEST(BuildMemory, TakesNoMoreThanItHas) {
    BuildMemory memory({0, 0}, 0);
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

bool is_mapped(const void* address) {
    constexpr uintptr_t kPage = 64 << 10;
    unsigned char is_resident[kPage / 4096];
    auto* byte = static_cast<std::byte*>(const_cast<void*>(address));
    return ::mincore(byte - reinterpret_cast<uintptr_t>(byte) % kPage, 1, is_resident) == 0;
}

/// What is kept of the front, and next to that, outlives the rest, which is given back in one go.
TEST(BuildMemory, KeepsPartOfItsFront) {
    constexpr size_t kFront = 5'000'000;
    constexpr size_t kKept = 250'000;
    std::optional<BuildMemory> memory(std::in_place, BuildMemory::Size{kFront, kFront}, size_t{1'000'000});
    LargeBuffer<uint32_t> front = memory->take_front<uint32_t>();
    ASSERT_GE(front.bytes(), kFront);
    LargeBuffer<uint32_t> other = memory->take<uint32_t>(16'700'000);  // nearly all there is behind it
    std::iota(front.data(), front.data() + front.size(), 0U);
    other[other.size() - 1] = 7;
    const uint32_t* first = front.data();
    const uint32_t* last = first + front.size() - 1;

    LargeBuffer<uint64_t> kept = memory->keep<uint64_t>(std::move(front), kKept);
    ASSERT_EQ(static_cast<const void*>(kept.data()), first);
    EXPECT_EQ(kept.size(), kKept);
    EXPECT_TRUE(memory->has_pages(kept));
    EXPECT_FALSE(memory->has_pages(memory->keep_more<uint64_t>(kKept + kKept / 2 + 1)));
    LargeBuffer<uint64_t> more = memory->keep_more<uint64_t>(kKept);
    EXPECT_TRUE(memory->has_pages(more));
    EXPECT_EQ(reinterpret_cast<uintptr_t>(more.data()) % 64, 0U);
    EXPECT_GE(more.data(), kept.data() + kKept);
    EXPECT_LE(reinterpret_cast<const std::byte*>(more.data() + kKept),
              reinterpret_cast<const std::byte*>(first) + kFront);
    std::fill_n(more.data(), kKept, 9U);
    EXPECT_TRUE(is_mapped(last));
    const uint32_t* elsewhere = &other[other.size() - 1];
    EXPECT_EQ(*elsewhere, 7U);
    other = {};
    memory.reset();
    EXPECT_FALSE(is_mapped(last));
    EXPECT_FALSE(is_mapped(elsewhere));
    for (size_t i = 0; i < kKept; ++i) {
        ASSERT_EQ(kept[i], (uint64_t{2 * i + 1} << 32) + 2 * i);
        ASSERT_EQ(more[i], 9U);
    }
    const uint64_t* last_of_both[] = {&kept[kKept - 1], &more[kKept - 1]};
    kept = {};
    more = {};
    EXPECT_FALSE(is_mapped(last_of_both[0]));
    EXPECT_FALSE(is_mapped(last_of_both[1]));
}

/// More than is usually used of the front leaves nothing to put beside it.
TEST(BuildMemory, KeepsMoreThanUsualWithoutPages) {
    constexpr size_t kUsual = 1'000'000;
    BuildMemory memory({4 * kUsual, kUsual}, 0);
    const LargeBuffer<std::byte> kept = memory.keep<std::byte>(memory.take_front<uint32_t>(), 2 * kUsual);
    EXPECT_FALSE(memory.has_pages(kept));
    EXPECT_FALSE(memory.has_pages(memory.keep_more<std::byte>(1)));
}

TEST(BuildMemory, KeepsInFreshMemoryWhatItsFrontIsTooSmallFor) {
    constexpr size_t kKept = size_t{1} << 20;
    std::optional<BuildMemory> memory(std::in_place, BuildMemory::Size{1000, 1000}, size_t{0});
    LargeBuffer<uint32_t> front = memory->take_front<uint32_t>();
    const uint32_t* first = front.data();
    LargeBuffer<uint64_t> kept = memory->keep<uint64_t>(std::move(front), kKept);
    EXPECT_NE(static_cast<const void*>(kept.data()), first);
    EXPECT_FALSE(memory->has_pages(kept));
    EXPECT_FALSE(memory->has_pages(memory->keep_more<uint64_t>(1)));
    memory.reset();
    kept[kKept - 1] = 1;
    EXPECT_EQ(kept[0], 0U);
}

/// Many inner nodes of two leaves each, one of them in part of a block and one in several.
TEST(SubtreeOutput, KeepsWhatItHoldsAsItGrows) {
    constexpr uint32_t kInner = 3000;
    const auto box_of = [](uint32_t i) {
        const auto at = static_cast<float>(i);
        return Box3f{{at, at, at}, {at + 1, at + 1, at + 1}};
    };
    BuildMemory memory({0, 0}, 0);
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
