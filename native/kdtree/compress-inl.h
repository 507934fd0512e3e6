// SPDX-License-Identifier: GPL-3.0-or-later
// Masks as bits, and compression of 32-bit lanes by a mask, whose cost is shared by all vectors that one mask
// compresses. Highway 1.0.3 has the same, but copies its table to the stack at every call where the instruction set
// lacks a compress instruction. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_COMPRESS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_COMPRESS_INL_H_
#undef ESPALIER_KDTREE_COMPRESS_INL_H_
#else
#define ESPALIER_KDTREE_COMPRESS_INL_H_
#endif

#include <hwy/highway.h>

#include <array>
#include <cstdint>
#include <cstring>
#include <type_traits>

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A mask as bits, the first lane's lowest.
template <class D>
HWY_INLINE uint64_t mask_bits(D d, hn::Mask<D> mask) {
    uint64_t bits = 0;
#if HWY_TARGET == HWY_AVX3_DL
    // The move is written out, since GCC 12 was seen to save 16 bits of a mask to the stack and to load 64 of them,
    // when left to widen it itself; Embree met the same (RenderKit/embree, pull request 574).
    constexpr size_t kLanes = hn::MaxLanes(D());
    if constexpr (kLanes == 64) {
        asm("kmovq %1, %0" : "=r"(bits) : "k"(mask.raw));
    } else if constexpr (kLanes == 32) {
        asm("kmovd %1, %k0" : "=r"(bits) : "k"(mask.raw));
    } else if constexpr (kLanes == 16) {
        asm("kmovw %1, %k0" : "=r"(bits) : "k"(mask.raw));
    } else {
        asm("kmovb %1, %k0" : "=r"(bits) : "k"(mask.raw));
        bits &= (uint64_t{1} << kLanes) - 1;
    }
    (void)d;
#else
    // Of the eight bytes that Highway may write, only as many read as there are: GCC 12 put all together in memory.
    constexpr size_t kLanes = hn::MaxLanes(D());
    static_assert(kLanes <= 32);
    std::conditional_t<(kLanes <= 8), uint8_t, std::conditional_t<(kLanes <= 16), uint16_t, uint32_t>> few;
    uint8_t bytes[8];
    hn::StoreMaskBits(d, mask, bytes);
    std::memcpy(&few, bytes, sizeof few);
    bits = few;
#endif
    return bits;
}

/// For each mask of so many lanes, which lane goes where: the chosen ones first, in order.
template <size_t kLanes>
constexpr std::array<std::array<uint8_t, kLanes>, size_t{1} << kLanes> make_compress_table() {
    std::array<std::array<uint8_t, kLanes>, size_t{1} << kLanes> table{};
    for (size_t bits = 0; bits < table.size(); ++bits) {
        size_t place = 0;
        for (const size_t wanted : {size_t{1}, size_t{0}}) {
            for (size_t lane = 0; lane < kLanes; ++lane) {
                if ((bits >> lane & 1) == wanted) {
                    table[bits][place++] = static_cast<uint8_t>(lane);
                }
            }
        }
    }
    return table;
}

/// Moves the lanes that a mask chooses to the front, in order. Which lane goes where is found once for all vectors: to
/// permute takes half of what the compress instruction does.
template <class D>
class Compression {
    using DI = hn::RebindToSigned<D>;

 public:
    HWY_INLINE Compression(D d, hn::Mask<D> mask) : bits_(mask_bits(d, mask)), lanes_(lanes_of(d, mask, bits_)) {}
    uint64_t bits() const { return bits_; }

    /// The chosen lanes first; what the others hold does not matter.
    template <class T>
    HWY_INLINE hn::Vec<hn::Rebind<T, D>> operator()(hn::Rebind<T, D> d, hn::Vec<hn::Rebind<T, D>> v) const {
        return hn::BitCast(d, hn::TableLookupLanes(hn::BitCast(D(), v), lanes_));
    }
    /// Stores the chosen lanes; writes a whole vector.
    template <class T>
    HWY_INLINE void store(hn::Rebind<T, D> d, hn::Vec<hn::Rebind<T, D>> v, T* to) const {
        hn::StoreU((*this)(d, v), d, to);
    }

 private:
    static HWY_INLINE auto lanes_of(D d, hn::Mask<D> mask, uint64_t bits) {
        const DI di;
#if HWY_TARGET == HWY_AVX3_DL
        (void)bits;
        return hn::IndicesFromVec(d, hn::Compress(hn::Iota(di, 0), hn::RebindMask(di, mask)));
#else
        (void)mask;
        static constexpr auto kTable = make_compress_table<hn::MaxLanes(D())>();
        return hn::IndicesFromVec(d, hn::PromoteTo(di, hn::LoadU(hn::Rebind<uint8_t, D>(), kTable[bits].data())));
#endif
    }

    uint64_t bits_;
    decltype(hn::IndicesFromVec(D(), hn::Zero(DI()))) lanes_;
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
