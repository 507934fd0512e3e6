// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <chrono>
#include <stdexcept>
#include <thread>
#include <vector>

#include "kdtree/parallel.h"

namespace espalier {
namespace {

TEST(Parallel, VisitsEachIndexOnce) {
    for (const int threads : {1, 2, 5, 16}) {
        for (const size_t count : {0U, 1U, 7U, 1000U}) {
            std::vector<std::atomic<int>> visits(count);
            parallel_for(threads, count, [&](size_t i, int worker) {
                EXPECT_GE(worker, 0);
                EXPECT_LT(worker, threads);
                ++visits[i];
            });
            for (const auto& visit : visits) {
                EXPECT_EQ(visit, 1);
            }
        }
    }
}

TEST(Parallel, PassesOnTheFirstException) {
    // Each call takes its time, so that the others cannot be through before the exception has been noticed.
    std::atomic<int> after{0};
    EXPECT_THROW(parallel_for(4, 4000,
                              [&](size_t i) {
                                  if (i == 10) {
                                      throw std::runtime_error("ten");
                                  }
                                  std::this_thread::sleep_for(std::chrono::microseconds(500));
                                  after += i > 3000 ? 1 : 0;
                              }),
                 std::runtime_error);
    EXPECT_EQ(after, 0) << "the rest is not begun";
    int sum = 0;
    parallel_for(1, 4, [&](size_t i) { sum += static_cast<int>(i); });
    EXPECT_EQ(sum, 6);
}

TEST(Parallel, CanBeNested) {
    std::atomic<int> count{0};
    parallel_for(3, 8, [&](size_t) { parallel_for(3, 8, [&](size_t) { ++count; }); });
    EXPECT_EQ(count, 64);
}

TEST(Parallel, DoesNotWaitForAnotherCallersWork) {
    std::atomic<int> inside{0};
    std::atomic<bool> may_end{false};
    std::thread other([&] {
        parallel_for(2, 2, [&](size_t) {
            ++inside;
            may_end.wait(false);
        });
    });
    while (inside < 2) {
        std::this_thread::yield();
    }
    int sum = 0;
    parallel_for(2, 10, [&](size_t i) { sum += static_cast<int>(i); });  // alone, so without a race
    EXPECT_EQ(sum, 45);
    may_end = true;
    may_end.notify_all();
    other.join();
}

}  // namespace
}  // namespace espalier
