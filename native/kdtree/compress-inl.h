// SPDX-License-Identifier: GPL-3.0-or-later
// Compression of 32-bit lanes by a mask, whose cost is shared by all vectors that one mask compresses. Highway 1.0.3
// has the same, but copies its table to the stack at every call where the instruction set lacks a compress instruction.
// Compiled once per instruction set (see build_kernels.cpp).

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

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

template <class D>
HWY_INLINE uint64_t mask_bits(D d, hn::Mask<D> mask) {
#if HWY_TARGET == HWY_AVX3_DL
    (void)d;
    return mask.raw;
#else
    uint8_t bytes[8] = {};
    hn::StoreMaskBits(d, mask, bytes);
    uint64_t bits = 0;
    std::memcpy(&bits, bytes, sizeof bits);
    return bits;
#endif
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

#if HWY_TARGET <= HWY_AVX3 && defined(__x86_64__)
template <class D>
class Compression {
 public:
    HWY_INLINE Compression(D d, hn::Mask<D> mask) : d_(d), mask_(mask), bits_(mask_bits(d, mask)) {}
    uint64_t bits() const { return bits_; }

    /// The chosen lanes first; what the others hold does not matter.
    template <class T>
    HWY_INLINE hn::Vec<hn::Rebind<T, D>> operator()(hn::Rebind<T, D> d, hn::Vec<hn::Rebind<T, D>> v) const {
        return hn::Compress(v, hn::RebindMask(d, mask_));
    }
    /// Stores the chosen lanes; may write a whole vector.
    template <class T>
    HWY_INLINE void store(hn::Rebind<T, D> d, hn::Vec<hn::Rebind<T, D>> v, T* to) const {
        hn::CompressStore(v, hn::RebindMask(d, mask_), d, to);
    }

 private:
    D d_;
    hn::Mask<D> mask_;
    uint64_t bits_;
};
#else
template <class D>
class Compression {
    static constexpr size_t kLanes = hn::MaxLanes(D());
    static_assert(kLanes == 4 || kLanes == 8);
    using DI = hn::RebindToSigned<D>;
    static constexpr auto kTable = make_compress_table<kLanes>();

 public:
    HWY_INLINE Compression(D d, hn::Mask<D> mask)
        : bits_(mask_bits(d, mask)),
          lanes_(hn::IndicesFromVec(D(),
                                    hn::PromoteTo(DI(), hn::LoadU(hn::Rebind<uint8_t, D>(), kTable[bits_].data())))) {}
    uint64_t bits() const { return bits_; }

    template <class T>
    HWY_INLINE hn::Vec<hn::Rebind<T, D>> operator()(hn::Rebind<T, D> d, hn::Vec<hn::Rebind<T, D>> v) const {
        return hn::BitCast(d, hn::TableLookupLanes(hn::BitCast(D(), v), lanes_));
    }
    template <class T>
    HWY_INLINE void store(hn::Rebind<T, D> d, hn::Vec<hn::Rebind<T, D>> v, T* to) const {
        hn::StoreU((*this)(d, v), d, to);
    }

 private:
    uint64_t bits_;
    decltype(hn::IndicesFromVec(D(), hn::Zero(DI()))) lanes_;
};
#endif

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
