// SPDX-License-Identifier: GPL-3.0-or-later
// How a leaf's references lie in its blocks: such that parts of the leaf, two blocks each, have small boxes of their
// own, by halves of whichever axis gives the smallest. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_LEAF_PARTS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_LEAF_PARTS_INL_H_
#undef ESPALIER_KDTREE_LEAF_PARTS_INL_H_
#else
#define ESPALIER_KDTREE_LEAF_PARTS_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cstring>

#include "kdtree/build_kernels.h"
#include "kdtree/compress-inl.h"
#include "kdtree/slices-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A set of references as a bit mask.
template <size_t kWords>
struct Members {
    uint64_t word[kWords];

    /// So many, from the first on.
    static HWY_INLINE Members first(uint32_t count) {
        Members members;
        for (uint32_t w = 0; w < kWords; ++w) {
            const uint32_t left = count > 64 * w ? count - 64 * w : 0;
            members.word[w] = left >= 64 ? ~uint64_t{0} : (uint64_t{1} << left) - 1;
        }
        return members;
    }
    uint32_t half(size_t i) const { return static_cast<uint32_t>(word[i / 2] >> (32 * (i % 2))); }
    uint32_t count() const {
        uint32_t sum = 0;
        for (const uint64_t bits : word) {
            sum += static_cast<uint32_t>(std::popcount(bits));
        }
        return sum;
    }
};

/// A box in one or two vectors: the lower bounds, then the upper ones, negated, so that a union is a minimum.
struct BoxRow {
    using D = hn::CappedTag<float, 8>;
    static constexpr size_t kLength = 8;
    static constexpr size_t kVectors = kLength / hn::MaxLanes(D());
    hn::Vec<D> part[kVectors];

    static HWY_INLINE BoxRow load(const float* row) {
        return of_parts([&](size_t i) { return hn::Load(D(), row + i * hn::MaxLanes(D())); });
    }
    static HWY_INLINE BoxRow of(const Box3f& box) {
        const Vec3f lower = box.lower;
        const Vec3f upper = -box.upper;
        alignas(32) const float row[kLength] = {lower.x, lower.y, lower.z, 0, upper.x, upper.y, upper.z, 0};
        return load(row);
    }
    /// From each part's number. No row is made without its parts: GCC compiles a constructor that it makes itself for
    /// the base instruction set, where a vector's can not be inlined.
    template <class F>
    static HWY_INLINE BoxRow of_parts(const F& f) {
        if constexpr (kVectors == 1) {
            return {{f(0)}};
        } else {
            return {{f(0), f(1)}};
        }
    }

    friend HWY_INLINE BoxRow unite(const BoxRow& a, const BoxRow& b) {
        return of_parts([&](size_t i) { return hn::Min(a.part[i], b.part[i]); });
    }
    HWY_INLINE BoxRow cut_to(const BoxRow& bounds) const {
        return of_parts([&](size_t i) { return hn::Max(part[i], bounds.part[i]); });
    }
    HWY_INLINE Box3f box() const {
        alignas(32) float row[kLength];
        for (size_t i = 0; i < kVectors; ++i) {
            // Adding zero leaves none with a sign, which would depend on the order of the minima.
            hn::Store(hn::Add(part[i], hn::Zero(D())), D(), row + i * hn::MaxLanes(D()));
        }
        return {{row[0], row[1], row[2]}, {0 - row[4], 0 - row[5], 0 - row[6]}};
    }
    /// Of the box with lengths in another unit.
    HWY_INLINE float half_area(float unit) const {
#if HWY_TARGET == HWY_SSE4 || HWY_TARGET == HWY_NEON
        const auto size = hn::Neg(hn::Add(part[0], part[1]));
#else
        const auto size = hn::Neg(hn::Add(hn::LowerHalf(part[0]), hn::UpperHalf(hn::Full128<float>(), part[0])));
#endif
        const auto scaled = hn::Mul(size, hn::Set(hn::Full128<float>(), unit));
        const auto with_next = hn::Mul(scaled, hn::Shuffle0321(scaled));         // xy, yz, ...
        const auto with_second_next = hn::Mul(scaled, hn::Shuffle1032(scaled));  // xz, ...
        return hn::GetLane(hn::Add(hn::Add(with_next, with_second_next), hn::Shuffle2301(with_next)));
    }
};

/// Writes leaves that hold references of one node, of which there are at most 64 * kWords.
template <size_t kWords>
class LeafParts {
 public:
    static constexpr uint32_t kCapacity = 64 * kWords;

    /// arrange: whether leaves are to have parts.
    HWY_INLINE LeafParts(const References& references, const OpenNode& node, bool arrange)
        : triangles_(references.triangle), arrange_(arrange) {
        store_boxes(references, node.count);
        if (arrange) {
            store_steps(references, node);
        }
    }

    /// Appends a leaf of so many members, whose boxes are cut to `bounds`.
    HWY_INLINE void write(const Members<kWords>& members, uint32_t count, const Box3f& bounds,
                          SubtreeOutput& output) const {
        const SubtreeOutput::Leaf leaf = output.add_leaf(count);
        if (count == 0) {
            *leaf.box = Box3f{};
            return;
        }
        static constexpr auto kPlaces = make_places();
        uint8_t places[kCapacity + kMargin];
        pick(kPlaces.data(), members, places);
        const uint32_t parts = part_count(block_count(count));
        if (!arrange_ || parts == 0) {
            *leaf.box = union_of(places, count).cut_to(BoxRow::of(bounds)).box();
            copy_triangles(places, count, leaf.triangles);
            std::fill_n(leaf.part_boxes, parts, *leaf.box);
        } else if (kWords == 1 || count <= 64) {
            *leaf.box = Arrangement<1>(*this, members, places, bounds, leaf).write(count).box();
        } else if constexpr (kWords > 1) {
            *leaf.box = count <= 128 ? Arrangement<2>(*this, members, places, bounds, leaf).write(count).box()
                                     : Arrangement<kWords>(*this, members, places, bounds, leaf).write(count).box();
        }
    }

 private:
    static constexpr int kStepBits = 6;
    static constexpr size_t kMargin = 64;  ///< bytes that vectors may run over the end
    using DF = hn::CappedTag<float, 16>;

    /// The boxes reference by reference.
    HWY_INLINE void store_boxes(const References& references, uint32_t count) {
        const DF d;
        const hn::Full128<float> row;
        const auto zero = hn::Zero(d);
        for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
            alignas(64) float bounds[2][hn::MaxLanes(DF())][4];
            hn::StoreInterleaved4(hn::LoadU(d, references.lower[0] + i), hn::LoadU(d, references.lower[1] + i),
                                  hn::LoadU(d, references.lower[2] + i), zero, d, bounds[0][0]);
            hn::StoreInterleaved4(hn::Neg(hn::LoadU(d, references.upper[0] + i)),
                                  hn::Neg(hn::LoadU(d, references.upper[1] + i)),
                                  hn::Neg(hn::LoadU(d, references.upper[2] + i)), zero, d, bounds[1][0]);
            for (size_t k = 0; k < hn::Lanes(d); ++k) {
                hn::Store(hn::Load(row, bounds[0][k]), row, boxes_[i + k]);
                hn::Store(hn::Load(row, bounds[1][k]), row, boxes_[i + k] + 4);
            }
        }
    }

    /// The middles of the boxes, in steps along each side of the node.
    HWY_INLINE void store_steps(const References& references, const OpenNode& node) {
        constexpr int kSteps = 1 << kStepBits;
        const DF d;
        const hn::Rebind<int8_t, DF> d_steps;
        const hn::RebindToSigned<DF> di;
        for (int axis = 0; axis < 3; ++axis) {
            const auto a = static_cast<size_t>(axis);
            const float low = node.tight.lower[axis];
            const float high = node.tight.upper[axis];
            const auto origin = hn::Set(d, low + low);
            const auto scale = hn::Set(d, Slices::can_be_cut(low, high) ? 0.5F * kSteps / (high - low) : 0.0F);
            for (uint32_t i = 0; i < node.count; i += static_cast<uint32_t>(hn::Lanes(d))) {
                const auto twice =
                    hn::Add(hn::LoadU(d, references.lower[a] + i), hn::LoadU(d, references.upper[a] + i));
                const auto step = truncate(di, hn::Mul(hn::Sub(twice, origin), scale));
                hn::StoreU(hn::DemoteTo(d_steps, hn::Min(step, hn::Set(di, kSteps - 1))), d_steps,
                           reinterpret_cast<int8_t*>(steps_[a]) + i);
            }
        }
    }

    static constexpr std::array<uint8_t, kCapacity + kMargin> make_places() {
        std::array<uint8_t, kCapacity + kMargin> places{};
        for (size_t i = 0; i < kCapacity; ++i) {
            places[i] = static_cast<uint8_t>(i);
        }
        return places;
    }

    /// Of bytes, one a reference, those of members, in order; what follows them does not matter.
    template <size_t kN>
    static HWY_INLINE void pick(const uint8_t* from, const Members<kN>& members, uint8_t* to) {
#if HWY_TARGET == HWY_AVX3_DL
        for (size_t w = 0; w < kN; ++w) {
            const __m512i bytes = _mm512_loadu_si512(from + 64 * w);
            _mm512_storeu_si512(to, _mm512_maskz_compress_epi8(members.word[w], bytes));
            to += std::popcount(members.word[w]);
        }
#else
        // Eight are written at a time whatever the number of bits, since how often a loop runs could not be foreseen
        // (Langdale and Lemire 2019, section 3.1.1).
        for (size_t w = 0; w < kN; ++w) {
            uint64_t rest = members.word[w];
            const int bits = std::popcount(rest);
            int i = 0;
            do {
                for (const int end = i + 8; i < end; ++i, rest &= rest - 1) {
                    to[i] = from[64 * w + static_cast<size_t>(std::countr_zero(rest))];
                }
            } while (i < bits);
            to += bits;
        }
#endif
    }

    /// The union of the boxes at so many places, of which there is one. What lies behind the places is overwritten.
    HWY_INLINE BoxRow union_of(uint8_t* places, uint32_t count) const {
        // In four chains, since each minimum waits for the one before.
        constexpr uint32_t kChains = 4;
        std::memset(places + count, places[0], kChains);
        const BoxRow first = BoxRow::load(boxes_[places[0]]);
        BoxRow chain[kChains] = {first, first, first, first};
        for (uint32_t i = 0; i < count; i += kChains) {
            for (uint32_t k = 0; k < kChains; ++k) {
                chain[k] = unite(chain[k], BoxRow::load(boxes_[places[i + k]]));
            }
        }
        return unite(unite(chain[0], chain[1]), unite(chain[2], chain[3]));
    }

    HWY_INLINE void copy_triangles(const uint8_t* places, uint32_t count, uint32_t* to) const {
        for (uint32_t i = 0; i < count; ++i) {
            to[i] = triangles_[places[i]];
        }
    }

    /// Writes the parts of one leaf of at most 64 * kN members, which are numbered anew.
    template <size_t kN>
    class Arrangement {
     public:
        HWY_INLINE Arrangement(const LeafParts& node, const Members<kWords>& members, const uint8_t* places,
                               const Box3f& bounds, const SubtreeOutput::Leaf& leaf)
            : node_(node),
              places_(places),
              bounds_(BoxRow::of(bounds)),
              unit_(1 / std::max(largest_of(bounds.size()), 0x1p-100F)),
              triangles_(leaf.triangles),
              boxes_(leaf.part_boxes) {
            const hn::CappedTag<uint8_t, 64> d;
            for (size_t axis = 0; axis < 3; ++axis) {
                uint8_t steps[kCapacity + kMargin];
                pick(node.steps_[axis], members, steps);
                for (size_t i = 0; i < 64 * kN; i += hn::Lanes(d)) {
                    const auto step = hn::LoadU(d, steps + i);
                    for (int j = 0; j < kStepBits; ++j) {
                        const auto bit = hn::Set(d, static_cast<uint8_t>(1 << (kStepBits - 1 - j)));
                        const uint64_t bits = mask_bits(d, hn::TestBit(step, bit));
                        std::memcpy(reinterpret_cast<std::byte*>(middles_[axis][j].word) + i / 8, &bits,
                                    hn::MaxLanes(d) / 8);
                    }
                }
            }
        }

        /// Returns the leaf's box.
        HWY_INLINE BoxRow write(uint32_t count) { return write(Members<kN>::first(count), count); }

     private:
        /// Members of a part in two halves.
        struct Halves {
            Members<kN> members[2];
            BoxRow box[2];
            float cost;
        };

        /// Appends the parts of what has more than two blocks, and their boxes.
        BoxRow write(const Members<kN>& members, uint32_t count) {
            const uint32_t first_count = first_blocks(block_count(count)) * kBlockSize;
            const uint32_t counts[2] = {first_count, count - first_count};
            const Halves along[3] = {halves_along(0, members, counts), halves_along(1, members, counts),
                                     halves_along(2, members, counts)};
            const size_t of_two = along[1].cost < along[0].cost ? 1 : 0;
            const Halves& halves = along[along[2].cost < along[of_two].cost ? 2 : of_two];
            for (size_t half = 0; half < 2; ++half) {
                *boxes_++ = halves.box[half].box();
                if (block_count(counts[half]) > 2) {
                    write(halves.members[half], counts[half]);
                    continue;
                }
                uint8_t places[kCapacity + kMargin];
                pick(places_, halves.members[half], places);
                node_.copy_triangles(places, counts[half], triangles_);
                triangles_ += counts[half];
            }
            return unite(halves.box[0], halves.box[1]);
        }

        HWY_INLINE BoxRow box_of(const Members<kN>& members, uint32_t count) const {
            uint8_t places[kCapacity + kMargin];
            pick(places_, members, places);
            return node_.union_of(places, count).cut_to(bounds_);
        }

        /// Those whose middles come first along an axis, and the others.
        HWY_INLINE Halves halves_along(size_t axis, const Members<kN>& members, const uint32_t (&counts)[2]) const {
            const Members<kN> first = lowest(members, axis, counts[0]);
            Members<kN> others;
            for (size_t w = 0; w < kN; ++w) {
                others.word[w] = members.word[w] & ~first.word[w];
            }
            const BoxRow first_box = box_of(first, counts[0]);
            const BoxRow others_box = box_of(others, counts[1]);
            const float cost = first_box.half_area(unit_) * static_cast<float>(block_count(counts[0])) +
                               others_box.half_area(unit_) * static_cast<float>(block_count(counts[1]));
            return {{first, others}, {first_box, others_box}, cost};
        }

        /// So many of the references, those whose middles come first along an axis; where middles are in one step,
        /// those that come first in the mesh.
        HWY_INLINE Members<kN> lowest(const Members<kN>& members, size_t axis, uint32_t wanted) const {
            Members<kN> chosen{};
            Members<kN> undecided = members;
            // Bit by bit, the highest first: either all whose bit is zero are among those wanted, or all others are
            // not.
            for (const Members<kN>& bit : middles_[axis]) {
                Members<kN> zeros;
                for (size_t w = 0; w < kN; ++w) {
                    zeros.word[w] = undecided.word[w] & ~bit.word[w];
                }
                const uint32_t count = zeros.count();
                const uint64_t all = count <= wanted ? ~uint64_t{0} : 0;  // no branch: it could not be foreseen
                wanted -= count & static_cast<uint32_t>(all);
                for (size_t w = 0; w < kN; ++w) {
                    chosen.word[w] |= zeros.word[w] & all;
                    undecided.word[w] &= ~(bit.word[w] ^ all);
                }
            }
#if HWY_TARGET == HWY_AVX3_DL
            for (size_t w = 0; w < kN; ++w) {  // without a branch on their number
                const auto some = std::min(wanted, static_cast<uint32_t>(std::popcount(undecided.word[w])));
                chosen.word[w] |= _pdep_u64(_bzhi_u64(~uint64_t{0}, some), undecided.word[w]);
                wanted -= some;
            }
#else
            for (size_t w = 0; wanted != 0; ++w) {
                for (uint64_t rest = undecided.word[w]; rest != 0 && wanted != 0; --wanted) {
                    chosen.word[w] |= rest & -rest;
                    rest &= rest - 1;
                }
            }
#endif
            return chosen;
        }

        const LeafParts& node_;
        const uint8_t* places_;
        BoxRow bounds_;
        float unit_;  ///< such that areas neither overflow nor vanish
        uint32_t* triangles_;
        Box3f* boxes_;
        Members<kN> middles_[3][kStepBits];  ///< those that have each bit in their step, the highest first
    };

    const uint32_t* triangles_;
    bool arrange_;
    alignas(64) float boxes_[kCapacity][BoxRow::kLength];
    alignas(64) uint8_t steps_[3][kCapacity + kMargin];
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
