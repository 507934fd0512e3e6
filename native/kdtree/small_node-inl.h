// SPDX-License-Identifier: GPL-3.0-or-later
// The last references of a subtree, as one bit mask: each candidate plane has a mask of the references to its left
// and one of those to its right, so that counts are population counts and children are intersections, and no reference
// is moved again. After the small nodes of Zhou, Hou, Wang and Guo 2008, section 3.3. Compiled once per instruction set
// (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_SMALL_NODE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_SMALL_NODE_INL_H_
#undef ESPALIER_KDTREE_SMALL_NODE_INL_H_
#else
#define ESPALIER_KDTREE_SMALL_NODE_INL_H_
#endif

#include <hwy/highway.h>

#include <array>
#include <bit>
#include <cstring>

#include "kdtree/binning-inl.h"
#include "kdtree/build_kernels.h"
#include "kdtree/compress-inl.h"
#include "kdtree/slice_masks-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A set of references as a bit mask.
template <size_t kWords>
struct Members {
    uint64_t word[kWords];

    uint32_t half(size_t i) const { return static_cast<uint32_t>(word[i / 2] >> (32 * (i % 2))); }
    uint32_t count() const {
        uint32_t sum = 0;
        for (const uint64_t bits : word) {
            sum += static_cast<uint32_t>(std::popcount(bits));
        }
        return sum;
    }
};

/// Finishes a node of at most 64 * kWords references.
template <size_t kWords>
class SmallNode {
 public:
    static constexpr uint32_t kCapacity = 64 * kWords;
    static constexpr int kStepBits = 6;

    HWY_INLINE SmallNode(const References& references, const OpenNode& node, const BuildParameters& parameters,
                         SubtreeOutput& output)
        : parameters_(parameters),
          traversal_cost_(static_cast<float>(parameters.sah.traversal)),
          block_cost_(static_cast<float>(parameters.sah.block)),
          triangles_(references.triangle),
          output_(output) {
        for (int axis = 0; axis < 3; ++axis) {
            const auto a = static_cast<size_t>(axis);
            place_planes(axis, node.count, references.lower[a], references.upper[a], node.tight);
        }
        store_boxes(references, node.count);
        if (parameters.arrange) {
            store_middles(references, node);
        }
        Members<kWords> all;
        for (uint32_t w = 0; w < kWords; ++w) {
            const uint32_t left = node.count > 64 * w ? node.count - 64 * w : 0;
            all.word[w] = left >= 64 ? ~uint64_t{0} : (uint64_t{1} << left) - 1;
        }
        cost_ = split(all, node);
    }
    float cost() const { return cost_; }  ///< per ray that meets the node's cell

 private:
    using DF = hn::CappedTag<float, 16>;

    /// Per axis and plane the references that begin before the plane, or those that end behind it: half words, as wide
    /// as a lane that counts references.
    using PlaneMasks = uint32_t[3][2 * kWords][kPlanes];

    /// The planes of one axis and the masks of what begins before and ends behind each.
    HWY_INLINE void place_planes(int axis, uint32_t count, const float* lowers, const float* uppers,
                                 const Box3f& tight) {
        const DF df;
        const float lower = tight.lower[axis];
        const float upper = tight.upper[axis];
        const Slices slices(lower, upper);
        float* positions = positions_[axis];
        auto& left = left_[axis];
        auto& right = right_[axis];
        reach_[axis] = reach_beyond_slices(lower, upper);
        if (slices.scale == 0) {
            std::fill(positions, positions + kPlanes, std::numeric_limits<float>::infinity());  // never inside the cell
            std::memset(left, 0, sizeof left);
            std::memset(right, 0, sizeof right);
            return;
        }
        for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(df))) {
            hn::Store(slice_positions(df, lower, upper, j), df, positions + j);
        }
        mask_slices(lowers, uppers, slices, count, left, right);
    }

    /// The boxes reference by reference, upper bounds negated: a union is two minima.
    HWY_INLINE void store_boxes(const References& references, uint32_t count) {
        const DF d;
        for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
            hn::StoreInterleaved4(hn::LoadU(d, references.lower[0] + i), hn::LoadU(d, references.lower[1] + i),
                                  hn::LoadU(d, references.lower[2] + i), hn::Zero(d), d, lowers_[i]);
            hn::StoreInterleaved4(hn::Neg(hn::LoadU(d, references.upper[0] + i)),
                                  hn::Neg(hn::LoadU(d, references.upper[1] + i)),
                                  hn::Neg(hn::LoadU(d, references.upper[2] + i)), hn::Zero(d), d, uppers_[i]);
        }
    }

    /// The middles of the boxes, in steps along each side of the node.
    HWY_INLINE void store_middles(const References& references, const OpenNode& node) {
        constexpr int kSteps = 1 << kStepBits;
        const DF d;
        const hn::Rebind<int8_t, DF> d_steps;
        const hn::RebindToSigned<DF> di;
        const hn::CappedTag<uint8_t, 64> d8;
        for (int axis = 0; axis < 3; ++axis) {
            const auto a = static_cast<size_t>(axis);
            const float low = node.tight.lower[axis];
            const float high = node.tight.upper[axis];
            const auto origin = hn::Set(d, low + low);
            const auto scale = hn::Set(d, Slices::can_be_cut(low, high) ? 0.5F * kSteps / (high - low) : 0.0F);
            alignas(64) int8_t steps[kCapacity];
            for (uint32_t i = 0; i < node.count; i += static_cast<uint32_t>(hn::Lanes(d))) {
                const auto twice =
                    hn::Add(hn::LoadU(d, references.lower[a] + i), hn::LoadU(d, references.upper[a] + i));
                const auto step = truncate(di, hn::Mul(hn::Sub(twice, origin), scale));
                hn::StoreU(hn::DemoteTo(d_steps, hn::Min(step, hn::Set(di, kSteps - 1))), d_steps, steps + i);
            }
            for (size_t i = 0; i < node.count; i += hn::Lanes(d8)) {
                const auto step = hn::Load(d8, reinterpret_cast<const uint8_t*>(steps) + i);
                for (int j = 0; j < kStepBits; ++j) {
                    const auto bit = hn::Set(d8, static_cast<uint8_t>(1 << (kStepBits - 1 - j)));
                    const uint64_t bits = mask_bits(d8, hn::TestBit(step, bit));
                    std::memcpy(reinterpret_cast<std::byte*>(middles_[axis][j].word) + i / 8, &bits,
                                hn::MaxLanes(d8) / 8);
                }
            }
        }
    }

    /// The cheapest plane inside the cell.
    HWY_INLINE CheapestPlane<DF> cheapest_plane(const Members<kWords>& members, const SplitCosts<DF>& costs,
                                                uint64_t affordable) const {
        const DF df;
        const hn::RebindToUnsigned<DF> du;
        const hn::RebindToSigned<DF> di;
        const auto round_up = hn::Set(du, kBlockSize - 1);
        const auto too_many = hn::Set(di, static_cast<int32_t>(std::min<uint64_t>(affordable, 2 * kCapacity) + 1));
        CheapestPlane cheapest(df);
        // Where the planes of an axis are one vector, half words without members cost less than a branch on their
        // number.
        constexpr bool kSkipsEmpty = hn::MaxLanes(DF()) < kPlanes;
        size_t half[2 * kWords];
        size_t halves = 0;
        for (size_t w = 0; w < 2 * kWords; ++w) {
            half[halves] = w;
            halves += !kSkipsEmpty || members.half(w) != 0 ? 1 : 0;
        }
        for (int axis = 0; axis < 3; ++axis) {
            for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(df))) {
                auto left = hn::Zero(du);
                auto right = hn::Zero(du);
                for (size_t k = 0; k < halves; ++k) {
                    const size_t w = half[k];
                    const auto member_bits = hn::Set(du, members.half(w));
                    const auto of = [&](const PlaneMasks& masks) {
                        return hn::PopulationCount(hn::And(hn::Load(du, masks[axis][w] + j), member_bits));
                    };
                    left = hn::Add(left, of(left_));
                    right = hn::Add(right, of(right_));
                }
                const auto left_blocks = hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(left, round_up))));
                const auto right_blocks =
                    hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(right, round_up))));
                const auto cost = costs(axis, hn::Load(df, positions_[axis] + j), left_blocks, right_blocks);
                const auto is_affordable = hn::Lt(hn::BitCast(di, hn::Add(left, right)), too_many);
                cheapest.offer(axis * kPlanes + j,
                               hn::IfThenElse(hn::RebindMask(df, is_affordable), cost, hn::Inf(df)));
            }
        }
        return cheapest;
    }

    static Members<kWords> on_side(const Members<kWords>& members, const PlaneMasks& masks, int axis, int plane) {
        Members<kWords> side;
        for (size_t w = 0; w < kWords; ++w) {
            const uint64_t high = masks[axis][2 * w + 1][plane];
            side.word[w] = members.word[w] & (high << 32 | masks[axis][2 * w][plane]);
        }
        return side;
    }

    /// Builds below a set of references; returns the cost of what was built, per ray that meets the cell.
    float split(const Members<kWords>& members, const OpenNode& node) {
        const float leaf_cost = block_cost_ * static_cast<float>(block_count(node.count));
        // A leaf of so few blocks is cheaper than any step.
        if (leaf_cost <= traversal_cost_ || node.depth >= parameters_.sah.max_depth) {
            write_leaf(members, node);
            return leaf_cost;
        }
        const CellShape shape(node.cell);
        if (!shape.is_splittable()) {
            write_leaf(members, node);
            return leaf_cost;
        }
        const DF df;
        const SplitCosts<DF> costs(df, node, shape, parameters_.sah);
        const CheapestPlane<DF> cheapest = cheapest_plane(members, costs, node.count + node.spare);
        if (!(cheapest.cost() < leaf_cost)) {
            write_leaf(members, node);
            return leaf_cost;
        }
        const int axis = cheapest.index() / kPlanes;
        const int plane = cheapest.index() % kPlanes;
        const Split split_at{axis, positions_[axis][plane], cheapest.cost()};
        const Members<kWords> left_members = on_side(members, left_, axis, plane);
        const Members<kWords> right_members = on_side(members, right_, axis, plane);
        OpenNode left;
        OpenNode right;
        open_children(node, split_at, {left_members.count(), right_members.count(), {}, {}}, left, right);

        const size_t first_triangle = output_.triangle_count();
        const size_t index = output_.open_inner();
        const float left_cost = split(left_members, left);
        const size_t right_child = output_.node_count();
        const float right_cost = split(right_members, right);
        const auto area = [&](const OpenNode& child) {
            return hn::GetLane(costs.relative_area(axis, hn::Set(df, child.cell.size()[axis])));
        };
        const float cost = traversal_cost_ + (area(left) * left_cost + area(right) * right_cost);
        if (leaf_cost <= cost) {  // the promise of the greedy choice was not kept: take the split back
            output_.rewind(index, first_triangle);
            write_leaf(members, node);
            return leaf_cost;
        }
        output_.close_inner(index, split_at, right_child);
        return cost;
    }

    HWY_INLINE void write_leaf(const Members<kWords>& members, const OpenNode& node) {
        const SubtreeOutput::Leaf leaf = output_.add_leaf(node.count);
        if (node.count == 0) {
            *leaf.box = Box3f{};
            return;
        }
        LeafWriter writer{{}, {}, leaf.triangles, leaf.part_boxes};
        for (int axis = 0; axis < 3; ++axis) {
            writer.lower[axis] = node.cell.lower[axis] - reach_[axis];
            writer.negated_upper[axis] = -(node.cell.upper[axis] + reach_[axis]);
        }
        const Vec3f size = node.cell.size();
        const uint32_t whole = parameters_.arrange ? 2 : kCapacity / kBlockSize;
        *leaf.box = box(write_part(members, node.count, {size.x, size.y, size.z}, whole, writer));
        if (!parameters_.arrange) {
            std::fill_n(leaf.part_boxes, part_count(block_count(node.count)), *leaf.box);
        }
    }

    /// A leaf that is being written: the cell that bounds its boxes, and where triangles and boxes of parts go.
    struct LeafWriter {
        alignas(16) float lower[4];
        alignas(16) float negated_upper[4];
        uint32_t* triangles;
        Box3f* boxes;
    };

    /// A box in vectors, the upper bounds negated.
    struct Bounds {
        hn::Vec<hn::Full128<float>> lower;
        hn::Vec<hn::Full128<float>> negated_upper;
    };
    static HWY_INLINE Box3f box(Bounds bounds) {
        const hn::Full128<float> d;
        alignas(16) float lower[4];
        alignas(16) float upper[4];
        hn::Store(bounds.lower, d, lower);
        hn::Store(hn::Sub(hn::Zero(d), bounds.negated_upper), d, upper);
        return {{lower[0], lower[1], lower[2]}, {upper[0], upper[1], upper[2]}};
    }

    /// Appends a part of a leaf, whose size is about this, and the boxes of its own parts, if it has more than `whole`
    /// blocks; returns its bounds.
    Bounds write_part(const Members<kWords>& members, uint32_t count, std::array<float, 3> size, uint32_t whole,
                      LeafWriter& writer) const {
        const hn::Full128<float> d;
        const uint32_t blocks = block_count(count);
        if (blocks <= whole) {
            auto lower = hn::Inf(d);
            auto negated_upper = hn::Inf(d);
            uint8_t places[kCapacity + 64];
            list(members, places);
            for (uint32_t i = 0; i < count; ++i) {
                const size_t place = places[i];
                writer.triangles[i] = triangles_[place];
                lower = hn::Min(lower, hn::Load(d, lowers_[place]));
                negated_upper = hn::Min(negated_upper, hn::Load(d, uppers_[place]));
            }
            writer.triangles += count;
            return {hn::Add(hn::Max(lower, hn::Load(d, writer.lower)), hn::Zero(d)),
                    hn::Max(negated_upper, hn::Load(d, writer.negated_upper))};
        }
        const size_t axis = size[0] >= std::max(size[1], size[2]) ? 0 : size[1] >= size[2] ? 1 : 2;
        size[axis] *= 0.5F;
        const uint32_t first_count = first_blocks(blocks) * kBlockSize;
        const Members<kWords> first_members = lowest(members, axis, first_count);
        Members<kWords> others;
        for (size_t w = 0; w < kWords; ++w) {
            others.word[w] = members.word[w] & ~first_members.word[w];
        }
        Box3f* first_box = writer.boxes++;
        const Bounds first = write_part(first_members, first_count, size, whole, writer);
        *first_box = box(first);
        Box3f* second_box = writer.boxes++;
        const Bounds second = write_part(others, count - first_count, size, whole, writer);
        *second_box = box(second);
        return {hn::Min(first.lower, second.lower), hn::Min(first.negated_upper, second.negated_upper)};
    }

    /// The members' places, in order; what follows them does not matter.
    static HWY_INLINE void list(const Members<kWords>& members, uint8_t* places) {
#if HWY_TARGET == HWY_AVX3_DL
        const hn::Full512<uint8_t> d;
        auto place = hn::Iota(d, 0);
        for (const uint64_t bits : members.word) {
            _mm512_storeu_si512(places, _mm512_maskz_compress_epi8(bits, place.raw));
            places += std::popcount(bits);
            place = hn::Add(place, hn::Set(d, 64));
        }
#else
        // Eight are written at a time whatever the number of bits, since how often a loop runs could not be foreseen
        // (Langdale and Lemire 2019, section 3.1.1).
        for (size_t w = 0; w < kWords; ++w) {
            uint64_t rest = members.word[w];
            const int bits = std::popcount(rest);
            int i = 0;
            do {
                for (const int end = i + 8; i < end; ++i, rest &= rest - 1) {
                    places[i] = static_cast<uint8_t>(64 * w + static_cast<size_t>(std::countr_zero(rest)));
                }
            } while (i < bits);
            places += bits;
        }
#endif
    }

    /// So many of the references, those whose middles come first along an axis; where middles are in one step, those
    /// that come first in the mesh.
    HWY_INLINE Members<kWords> lowest(const Members<kWords>& members, size_t axis, uint32_t wanted) const {
        Members<kWords> chosen{};
        Members<kWords> undecided = members;
        // Bit by bit, the highest first: either all whose bit is zero are among those wanted, or all others are not.
        for (const Members<kWords>& bit : middles_[axis]) {
            Members<kWords> zeros;
            for (size_t w = 0; w < kWords; ++w) {
                zeros.word[w] = undecided.word[w] & ~bit.word[w];
            }
            const uint32_t count = zeros.count();
            const uint64_t all = count <= wanted ? ~uint64_t{0} : 0;  // no branch: it could not be foreseen
            wanted -= count & static_cast<uint32_t>(all);
            for (size_t w = 0; w < kWords; ++w) {
                chosen.word[w] |= zeros.word[w] & all;
                undecided.word[w] &= ~(bit.word[w] ^ all);
            }
        }
        for (size_t w = 0; wanted != 0; ++w) {
            for (uint64_t rest = undecided.word[w]; rest != 0 && wanted != 0; --wanted) {
                chosen.word[w] |= rest & -rest;
                rest &= rest - 1;
            }
        }
        return chosen;
    }

    const BuildParameters& parameters_;
    float traversal_cost_;
    float block_cost_;
    float cost_;
    const uint32_t* triangles_;
    SubtreeOutput& output_;
    float reach_[3];
    alignas(64) float positions_[3][kPlanes];
    alignas(64) PlaneMasks left_;
    alignas(64) PlaneMasks right_;
    alignas(64) float lowers_[kCapacity][4];
    alignas(64) float uppers_[kCapacity][4];
    Members<kWords> middles_[3][kStepBits];  ///< those that have each bit in their step, the highest first
};

/// Finishes a node of at most parameters.small_node references; returns the cost of what was built.
inline float finish_small_node(const References& references, const OpenNode& node, const BuildParameters& parameters,
                               SubtreeOutput& output) {
    return parameters.small_node <= SmallNode<1>::kCapacity ? SmallNode<1>(references, node, parameters, output).cost()
                                                            : SmallNode<4>(references, node, parameters, output).cost();
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
