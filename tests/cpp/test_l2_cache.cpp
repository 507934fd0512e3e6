// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>
#include <unistd.h>

#include "kdtree/l2_cache.h"

namespace espalier {
namespace {

TEST(L2Cache, IsAsLargeAsTheSystemSaysOrTheDefault) {
    long told = 0;
#ifdef _SC_LEVEL2_CACHE_SIZE
    told = sysconf(_SC_LEVEL2_CACHE_SIZE);
#endif
    EXPECT_EQ(l2_cache_bytes(), told > 0 ? static_cast<size_t>(told) : size_t{1} << 20);
}

}  // namespace
}  // namespace espalier
