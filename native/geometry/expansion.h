// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cmath>
#include <vector>

namespace espalier {

/// An exact number: the sum of doubles that do not overlap, smallest first, as in Shewchuk 1997, "Adaptive precision
/// floating-point arithmetic and fast robust geometric predicates". Sums, differences and products of floats stay exact
/// as long as no product of their parts leaves double's range, which holds for up to seven factors that are differences
/// of floats of at most 2^61: all are multiples of 2^-149, and so the product's last bit lies above 2^-1074.
class Expansion {
 public:
    Expansion() = default;
    explicit Expansion(double value) {
        if (value != 0) {
            parts_.push_back(value);
        }
    }

    /// a - b, exactly.
    static Expansion difference(double a, double b) {
        Expansion result(a);
        result.grow(-b);
        return result;
    }

    friend Expansion operator+(const Expansion& a, const Expansion& b) {
        Expansion sum = a;
        for (const double part : b.parts_) {
            sum.grow(part);
        }
        return sum;
    }
    friend Expansion operator-(const Expansion& a, const Expansion& b) {
        Expansion sum = a;
        for (const double part : b.parts_) {
            sum.grow(-part);
        }
        return sum;
    }
    friend Expansion operator*(const Expansion& a, const Expansion& b) {
        Expansion product;
        for (const double x : a.parts_) {
            for (const double y : b.parts_) {
                product.add_product(x, y);
            }
        }
        return product;
    }

    /// -1, 0 or 1: the sign of the largest part, which outweighs all others together.
    int sign() const { return parts_.empty() ? 0 : (parts_.back() > 0 ? 1 : -1); }

    /// The value to within a relative error of 2^-52.
    double estimate() const {
        double sum = 0;
        for (const double part : parts_) {
            sum += part;
        }
        return sum;
    }

 private:
    /// GROW-EXPANSION with zero elimination: each step is TWO-SUM (Knuth).
    void grow(double value) {
        size_t kept = 0;
        double carry = value;
        for (const double part : parts_) {
            const double sum = carry + part;
            const double virtual_part = sum - carry;
            const double error = (carry - (sum - virtual_part)) + (part - virtual_part);
            if (error != 0) {
                parts_[kept++] = error;
            }
            carry = sum;
        }
        parts_.resize(kept);
        if (carry != 0) {
            parts_.push_back(carry);
        }
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

    std::vector<double> parts_;
};

}  // namespace espalier
