// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>

namespace espalier {

/// An exact number: the sum of doubles that do not overlap, smallest first, as in Shewchuk 1997, "Adaptive precision
/// floating-point arithmetic and fast robust geometric predicates". Sums, differences and products of floats stay exact
/// as long as no product of their parts leaves double's range, which holds for up to seven factors that are differences
/// of floats of at most 2^61: all are multiples of 2^-149, and so the product's last bit lies above 2^-1074.
class Expansion {
 public:
    Expansion() {}  // NOLINT(modernize-use-equals-default): the parts stay unset
    explicit Expansion(double value) { append(value); }
    Expansion(const Expansion& other) { *this = other; }
    Expansion& operator=(const Expansion& other) {
        count_ = other.count_;
        std::copy(other.begin(), other.end(), parts_.begin());
        return *this;
    }

    /// a - b, exactly.
    static Expansion difference(double a, double b) {
        Expansion result(a);
        result.grow(-b);
        return result;
    }

    friend Expansion operator+(const Expansion& a, const Expansion& b) {
        Expansion sum = a;
        for (const double part : b) {
            sum.grow(part);
        }
        return sum;
    }
    friend Expansion operator-(const Expansion& a, const Expansion& b) {
        Expansion sum = a;
        for (const double part : b) {
            sum.grow(-part);
        }
        return sum;
    }
    friend Expansion operator*(const Expansion& a, const Expansion& b) {
        Expansion product;
        for (const double x : a) {
            for (const double y : b) {
                product.add_product(x, y);
            }
        }
        return product;
    }

    /// -1, 0 or 1: the sign of the largest part, which outweighs all others together.
    int sign() const { return count_ == 0 ? 0 : (parts_[count_ - 1] > 0 ? 1 : -1); }

    /// The value to within a relative error of 2^-51. Its parts are nonadjacent (Shewchuk, theorem 10): each outweighs
    /// the double of all below it, so that nothing cancels.
    double estimate() const {
        double sum = 0;
        for (const double part : *this) {
            sum += part;
        }
        return sum;
    }

 private:
    /// Compressed, an expansion has few parts: 41 of 53 bits each make up the 2098 bits that doubles can name.
    static constexpr size_t kCapacity = 96;

    const double* begin() const { return parts_.data(); }
    const double* end() const { return parts_.data() + count_; }

    void append(double part) {
        if (part != 0) {
            parts_[count_++] = part;
        }
    }

    /// GROW-EXPANSION with zero elimination: each step is TWO-SUM (Knuth).
    void grow(double value) {
        if (count_ + 1 == kCapacity) {
            compress();
        }
        const size_t old_count = count_;
        count_ = 0;
        double carry = value;
        for (size_t i = 0; i < old_count; ++i) {
            const double part = parts_[i];
            const double sum = carry + part;
            const double virtual_part = sum - carry;
            append((carry - (sum - virtual_part)) + (part - virtual_part));
            carry = sum;
        }
        append(carry);
    }

    /// COMPRESS: the same value in as few parts as it needs. Each step is FAST-TWO-SUM (Dekker), larger summand first.
    void compress() {
        size_t bottom = count_ - 1;
        double carry = parts_[bottom];
        for (size_t i = bottom; i-- > 0;) {
            const double sum = carry + parts_[i];
            const double error = parts_[i] - (sum - carry);
            carry = sum;
            if (error != 0) {
                parts_[bottom--] = carry;
                carry = error;
            }
        }
        parts_[bottom] = carry;
        const size_t old_count = count_;
        count_ = 0;
        for (size_t i = bottom + 1; i < old_count; ++i) {
            const double sum = parts_[i] + carry;
            append(carry - (sum - parts_[i]));
            carry = sum;
        }
        append(carry);
    }

    /// TWO-PRODUCT (Dekker, Veltkamp): without fused operations, so that every machine takes the same way.
    void add_product(double x, double y) {
        const auto split = [](double value, double& high, double& low) {
            constexpr double kSplitter = 134217729.0;  // 2^27 + 1
            const double shifted = kSplitter * value;
            high = shifted - (shifted - value);
            low = value - high;
        };
        double x_high, x_low, y_high, y_low;
        split(x, x_high, x_low);
        split(y, y_high, y_low);
        const double product = x * y;
        const double error = x_low * y_low - (((product - x_high * y_high) - x_low * y_high) - x_high * y_low);
        grow(error);
        grow(product);
    }

    size_t count_ = 0;
    std::array<double, kCapacity> parts_;  // only the first count_ hold anything
};

}  // namespace espalier
