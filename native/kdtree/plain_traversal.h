// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>
#include <span>

#include "kdtree/traversal.h"

namespace espalier {

/// intersect() and occluded() without what makes hits exact: float decides and measures. Faster, and now and then
/// wrong; here only so that the price of exactness can be measured.
void plain_intersect(const Tree& tree, std::span<const Ray> rays, std::span<Hit> hits);
void plain_occluded(const Tree& tree, std::span<const Ray> rays, std::span<uint8_t> results);

}  // namespace espalier
