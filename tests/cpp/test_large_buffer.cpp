// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <vector>

#include "kdtree/large_buffer.h"
#include "kdtree/parallel.h"
#include "kdtree/wide_nodes.h"

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

TEST(WideNodes, KeepWhatTheyHoldAsTheyGrow) {
    constexpr uint32_t kNodes = 5000;
    TransientMemory memory(0);
    WideNodes with_room(100, memory);
    WideNodes without;
    for (WideNodes* nodes : {&with_room, &without}) {
        for (uint32_t i = 0; i < kNodes; ++i) {
            ASSERT_EQ(nodes->add(), i);
            (*nodes)[i].child[0] = i;
        }
        for (uint32_t i = 0; i < kNodes; ++i) {
            ASSERT_EQ((*nodes)[i].child[0], i);
        }
        nodes->clear();
        EXPECT_EQ(nodes->add(), 0U);
    }
}

}  // namespace
}  // namespace espalier
