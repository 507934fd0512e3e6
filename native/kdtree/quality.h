// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "kdtree/tree.h"

namespace espalier {

/// Fills in what the report says of the finished tree: counts, bytes, SAH cost and checksum.
void measure_quality(Tree& tree, int threads);

}  // namespace espalier
