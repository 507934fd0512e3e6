// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

namespace espalier {

/// Three numbers: a point, a direction or a colour.
template <class T>
struct Vec3 {
    T x{}, y{}, z{};

    constexpr T& operator[](int axis) { return axis == 0 ? x : axis == 1 ? y : z; }
    constexpr T operator[](int axis) const { return axis == 0 ? x : axis == 1 ? y : z; }

    constexpr Vec3& operator+=(Vec3 b) { return *this = *this + b; }
    friend constexpr Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
    friend constexpr Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
    friend constexpr Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
    friend constexpr Vec3 operator*(Vec3 a, T s) { return {a.x * s, a.y * s, a.z * s}; }
    friend constexpr Vec3 operator*(T s, Vec3 a) { return a * s; }
    friend constexpr Vec3 operator/(Vec3 a, T s) { return {a.x / s, a.y / s, a.z / s}; }
    friend constexpr Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
    friend constexpr bool operator==(Vec3, Vec3) = default;
};

using Vec3f = Vec3<float>;
using Vec3d = Vec3<double>;

template <class T>
constexpr T dot(Vec3<T> a, Vec3<T> b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class T>
constexpr Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <class T>
T length(Vec3<T> a) {
    return std::sqrt(dot(a, a));
}

template <class T>
Vec3<T> normalize(Vec3<T> a) {
    return a / length(a);
}

template <class T>
bool is_finite(Vec3<T> a) {
    return std::isfinite(a.x) && std::isfinite(a.y) && std::isfinite(a.z);
}

/// The largest of the components' sizes.
template <class T>
T largest_of(Vec3<T> a) {
    return std::max({std::abs(a.x), std::abs(a.y), std::abs(a.z)});
}

constexpr Vec3d to_double(Vec3f a) { return {a.x, a.y, a.z}; }

/// Rounds each component once.
constexpr Vec3f to_float(Vec3d a) {
    return {static_cast<float>(a.x), static_cast<float>(a.y), static_cast<float>(a.z)};
}

/// An axis-aligned box, closed; empty when some lower bound lies above its upper one.
struct Box3f {
    static constexpr float kInfinity = std::numeric_limits<float>::infinity();

    Vec3f lower{kInfinity, kInfinity, kInfinity};
    Vec3f upper{-kInfinity, -kInfinity, -kInfinity};

    constexpr bool is_empty() const { return !(lower.x <= upper.x && lower.y <= upper.y && lower.z <= upper.z); }
    constexpr Vec3f size() const { return upper - lower; }

    constexpr void extend(Vec3f p) { extend(Box3f{p, p}); }
    constexpr void extend(const Box3f& b) {
        for (int axis = 0; axis < 3; ++axis) {
            lower[axis] = std::min(lower[axis], b.lower[axis]);
            upper[axis] = std::max(upper[axis], b.upper[axis]);
        }
    }
    friend constexpr bool operator==(const Box3f&, const Box3f&) = default;
};

}  // namespace espalier
