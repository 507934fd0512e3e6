// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <set>

#include "kdtree/second_cache.h"

namespace espalier {
namespace {

constexpr size_t kDefault = size_t{1} << 20;

/// Of all processors, which may differ.
std::set<size_t> listed_sizes() {
    std::set<size_t> sizes;
    for (int cpu = 0;; ++cpu) {
        const std::filesystem::path caches = "/sys/devices/system/cpu/cpu" + std::to_string(cpu) + "/cache";
        if (!std::filesystem::exists(caches)) {
            return sizes;
        }
        std::ifstream file(caches / "index2" / "size");
        if (size_t kib = 0; file >> kib) {
            sizes.insert(kib << 10);
        }
    }
}

TEST(SecondCache, IsAsLargeAsTheSystemSays) {
    if (sysconf(_SC_LEVEL2_CACHE_SIZE) <= 0) {
        EXPECT_EQ(second_cache_bytes(), kDefault);
        return;
    }
    const std::set<size_t> sizes = listed_sizes();
    if (sizes.empty()) {
        GTEST_SKIP() << "this system does not list its caches";
    }
    EXPECT_TRUE(sizes.contains(second_cache_bytes())) << second_cache_bytes();
}

}  // namespace
}  // namespace espalier
