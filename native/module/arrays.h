// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cstdint>
#include <initializer_list>
#include <span>
#include <string>

#include "render/matrix.h"

namespace espalier {

/// Any length, in a shape that an array is checked against.
constexpr pybind11::ssize_t kAny = -1;

/// A contiguous NumPy array of a checked type and shape. Contiguous input is used where it lies, other input is copied.
template <class T>
struct Array {
    pybind11::array_t<T, pybind11::array::c_style> owner;

    std::span<const T> span() const { return {owner.data(), static_cast<size_t>(owner.size())}; }
    size_t rows() const { return static_cast<size_t>(owner.shape(0)); }
};

/// `value` as float32 of the given shape. `name` is how errors speak of it. Throws TypeError for another type,
/// ValueError for another shape.
Array<float> float_array(pybind11::handle value, const std::string& name,
                         std::initializer_list<pybind11::ssize_t> shape);

/// `value` as int32 of the given shape.
Array<int32_t> int_array(pybind11::handle value, const std::string& name,
                         std::initializer_list<pybind11::ssize_t> shape);

/// `value` as three vertex indices per triangle, int32 or uint32, all below `vertices`; throws IndexError for others.
Array<uint32_t> triangle_array(pybind11::handle value, const std::string& name, size_t vertices);

/// `value` as a 4x4 matrix of numbers.
Matrix4 matrix_from(pybind11::handle value, const std::string& name);

/// 0 stands for all threads of the machine. Throws ValueError for a negative number or one beyond reason.
int checked_threads(int threads, const std::string& name = "threads");

}  // namespace espalier
