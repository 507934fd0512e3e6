// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

#include "geometry/vec.h"

namespace espalier {

struct Split {
    int axis = -1;  ///< -1: the node is a leaf
    float position = 0;
    float cost = 0;
};

/// A node that is yet to be split.
struct OpenNode {
    Box3f cell;      ///< what the planes above leave of the scene's box
    Box3f tight;     ///< of the references' boxes
    uint32_t count;  ///< references
    uint64_t spare;  ///< references that its splits may still add: what bounds the memory of hostile scenes
    int depth;
};

}  // namespace espalier
