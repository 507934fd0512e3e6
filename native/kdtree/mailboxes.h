// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <cstdint>
#include <iterator>

#include "kdtree/node.h"

namespace espalier {

/// Which triangles a packet has been tested against, as far as is remembered: those on several sides of a plane lie in
/// several leaves (mailboxes: Amanatides and Woo 1987, section 2; here few, found by a triangle's index).
class Mailboxes {
 public:
    Mailboxes() { empty(); }

    /// From here on no triangle counts as known.
    void next_packet() {
        if (++packet_ == kPackets) {
            empty();
        }
    }

    /// 1 for a triangle that is not known, which it is from then on; otherwise 0.
    uint32_t is_new(uint32_t triangle) {
        uint32_t& box = boxes_[triangle % kCount];
        const uint32_t mark = triangle + packet_ * kMaxTriangles;
        const uint32_t result = box != mark ? 1 : 0;
        box = mark;
        return result;
    }

 private:
    static constexpr uint32_t kCount = 512;
    /// Packets are told apart by the bits that indices leave, but for one number, which stands for no triangle.
    static constexpr uint32_t kPackets = UINT32_MAX / kMaxTriangles;

    void empty() {
        std::fill(std::begin(boxes_), std::end(boxes_), kNoTriangle);
        packet_ = 0;
    }

    uint32_t packet_ = 0;
    uint32_t boxes_[kCount];
};

}  // namespace espalier
