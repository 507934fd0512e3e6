// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <hwy/base.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

#include "geometry/vec.h"
#include "kdtree/large_buffer.h"

namespace espalier {

/// References to triangles, as structure of arrays: the box of the part of each triangle that lies in the node, and its
/// index. Vector code may write up to kSlack items past the end.
struct References {
    std::array<float*, 3> lower{};
    std::array<float*, 3> upper{};
    uint32_t* triangle = nullptr;

    HWY_INLINE References at(size_t offset) const {
        References moved = *this;
        for (size_t axis = 0; axis < 3; ++axis) {
            moved.lower[axis] += offset;
            moved.upper[axis] += offset;
        }
        moved.triangle += offset;
        return moved;
    }
    Box3f box(size_t i) const {
        return {{lower[0][i], lower[1][i], lower[2][i]}, {upper[0][i], upper[1][i], upper[2][i]}};
    }
};

/// Copies `count` references; the two may overlap if `to` lies before `from`.
inline void copy_references(const References& from, size_t count, const References& to) {
    for (size_t axis = 0; axis < 3; ++axis) {
        std::copy(from.lower[axis], from.lower[axis] + count, to.lower[axis]);
        std::copy(from.upper[axis], from.upper[axis] + count, to.upper[axis]);
    }
    std::copy(from.triangle, from.triangle + count, to.triangle);
}

/// Memory for references. Pages are taken when they are first written.
class ReferenceBuffer {
 public:
    static constexpr size_t kArrays = 7;
    static constexpr size_t kSlack = 64;

    ReferenceBuffer() = default;
    /// usual_bytes: for how much it has huge pages.
    explicit ReferenceBuffer(size_t capacity, size_t usual_bytes = SIZE_MAX)
        : ReferenceBuffer(capacity, LargeBuffer<uint32_t>(stride_for(capacity) * kArrays, usual_bytes)) {}
    /// In memory of at least bytes_for(capacity).
    ReferenceBuffer(size_t capacity, LargeBuffer<uint32_t> memory)
        : stride_(stride_for(capacity)), memory_(std::move(memory)) {
        for (size_t axis = 0; axis < 3; ++axis) {
            references_.lower[axis] = reinterpret_cast<float*>(memory_.data() + stride_ * axis);
            references_.upper[axis] = reinterpret_cast<float*>(memory_.data() + stride_ * (axis + 3));
        }
        references_.triangle = memory_.data() + stride_ * 6;
    }
    static size_t bytes_for(size_t capacity) { return stride_for(capacity) * kArrays * sizeof(uint32_t); }
    const References& references() const { return references_; }
    size_t capacity() const { return stride_ - kSlack; }
    /// Of the memory, how much the references may take.
    size_t words() const { return stride_ * kArrays; }
    LargeBuffer<uint32_t>& memory() { return memory_; }
    /// Gives the memory away.
    LargeBuffer<uint32_t> take_memory() {
        references_ = {};
        return std::move(memory_);
    }

 private:
    /// Hardly ever a multiple of a page, so that the arrays do not compete for the same cache sets.
    static size_t stride_for(size_t capacity) { return (capacity + kSlack + 15) / 16 * 16 + 16; }

    size_t stride_ = 0;
    LargeBuffer<uint32_t> memory_;
    References references_;
};

}  // namespace espalier
