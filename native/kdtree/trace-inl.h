// SPDX-License-Identifier: GPL-3.0-or-later
// Which rays are traced in which way. Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_TRACE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_TRACE_INL_H_
#undef ESPALIER_KDTREE_TRACE_INL_H_
#else
#define ESPALIER_KDTREE_TRACE_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <cstdint>
#include <span>

#include "kdtree/finish-inl.h"
#include "kdtree/packet-inl.h"
#include "kdtree/ray_batch-inl.h"
#include "kdtree/stream-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {

/// Traces rays that are no packet as a few that are, one after the other, if there are such. Returns whether it has
/// traced all; if not, some may have been, and come to the same end once more.
template <class SomePacket, class Ends>
HWY_NOINLINE bool trace_parts(SomePacket& packet, const Ray* rays, uint32_t first, Ends& ends) {
    uint32_t parts[SomePacket::kMostParts];
    const size_t count = packet.part(parts);
    for (size_t i = 0; i < count; ++i) {
        if (!packet.gather(rays, parts[i])) {
            return false;
        }
        packet.trace();
        for (uint32_t rest = parts[i]; rest != 0; rest &= rest - 1) {
            const auto lane = static_cast<uint32_t>(std::countr_zero(rest));
            ends.add(first + lane, packet.place(lane));
        }
    }
    return count != 0;
}

/// Traces rays that belong together as packets and all others as a stream. Calls ends.add(first, packet) for the rays
/// of a packet; for others first ends.begin(first, count), and then ends.add(ray, place) at least for all that hit
/// something.
template <bool kAnyHit, bool kExact, class Ends>
HWY_INLINE void trace(const Tree& tree, std::span<const Ray> rays, Ends& ends) {
    constexpr size_t kChunk = 4096;
    constexpr size_t kPacket = Packet<kAnyHit, kExact>::kRays;
    static_assert(kChunk % kPacket == 0 && kPacket % RayBatch::kSize == 0);
    Packet<kAnyHit, kExact> packet(tree);
    Stream<kAnyHit, kExact> stream(tree, rays);
    uint32_t batches[kChunk / RayBatch::kSize];
    for (size_t begin = 0; begin < rays.size(); begin += kChunk) {
        const size_t end = std::min(begin + kChunk, rays.size());
        size_t count = 0;
        for (size_t i = begin; i < end; i += kPacket) {
            const bool is_full = i + kPacket <= end;
            if (is_full && packet.gather(&rays[i])) {
                packet.trace();
                ends.add(static_cast<uint32_t>(i), packet);
                continue;
            }
            ends.begin(static_cast<uint32_t>(i), std::min(kPacket, end - i));
            if (!is_full || !trace_parts(packet, &rays[i], static_cast<uint32_t>(i), ends)) {
                for (size_t first = i; first < std::min(i + kPacket, end); first += RayBatch::kSize) {
                    batches[count++] = static_cast<uint32_t>(first);
                }
            }
        }
        stream.run({batches, count}, [&](uint32_t ray, uint32_t place) { ends.add(ray, place); });
    }
}

template <bool kExact>
HWY_INLINE void intersect_all(const Tree& tree, std::span<const Ray> rays, std::span<Hit> hits) {
    FinishQueue<kExact> queue(tree.blocks.data(), rays, hits);
    trace<false, kExact>(tree, rays, queue);
    queue.flush();
}

/// Notes which rays are blocked.
template <bool kExact>
struct BlockedRays {
    std::span<uint8_t> results;

    HWY_INLINE void begin(uint32_t first, size_t count) { std::fill_n(results.begin() + first, count, uint8_t{0}); }
    HWY_INLINE void add(uint32_t ray, uint32_t place) { results[ray] = place != kNoPlace ? 1 : 0; }
    HWY_INLINE void add(uint32_t first, const Packet<true, kExact>& packet) {
        for (uint32_t lane = 0; lane < Packet<true, kExact>::kRays; ++lane) {
            add(first + lane, packet.place(lane));
        }
    }
};

template <bool kExact>
HWY_INLINE void occluded_all(const Tree& tree, std::span<const Ray> rays, std::span<uint8_t> results) {
    BlockedRays<kExact> blocked{results};
    trace<true, kExact>(tree, rays, blocked);
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
