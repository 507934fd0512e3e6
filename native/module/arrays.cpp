// SPDX-License-Identifier: GPL-3.0-or-later
#include "module/arrays.h"

namespace py = pybind11;

namespace espalier {
namespace {

constexpr int kMaxThreads = 1024;

std::string shape_text(std::initializer_list<py::ssize_t> shape) {
    std::string text;
    for (const py::ssize_t length : shape)
        text += (text.empty() ? "" : ", ") + (length == kAny ? "N" : std::to_string(length));
    return "[" + text + "]";
}

py::array require_array(py::handle value, const std::string& name) {
    if (!py::isinstance<py::array>(value)) {
        throw py::type_error(name + " must be a NumPy array, not " +
                             std::string(py::str(py::type::of(value).attr("__name__"))));
    }
    return py::reinterpret_borrow<py::array>(value);
}

void require_shape(const py::array& array, const std::string& name, std::initializer_list<py::ssize_t> shape) {
    bool fits = array.ndim() == static_cast<py::ssize_t>(shape.size());
    py::ssize_t axis = 0;
    for (const py::ssize_t length : shape) {
        fits = fits && (length == kAny || array.shape(axis) == length);
        ++axis;
    }
    if (!fits) {
        throw py::value_error(name + " must have shape " + shape_text(shape) + ", not " +
                              std::string(py::str(array.attr("shape"))));
    }
}

[[noreturn]] void wrong_type(const py::array& array, const std::string& name, const char* wanted) {
    throw py::type_error(name + " must be " + wanted + ", not " + std::string(py::str(array.dtype())));
}

template <class T>
bool holds(const py::array& array) {
    return py::dtype::of<T>().equal(array.dtype());
}

template <class T>
Array<T> contiguous(const py::array& array) {
    return {py::array_t<T, py::array::c_style>::ensure(array)};
}

}  // namespace

Array<float> float_array(py::handle value, const std::string& name, std::initializer_list<py::ssize_t> shape) {
    const py::array array = require_array(value, name);
    if (!holds<float>(array))
        wrong_type(array, name, "float32");
    require_shape(array, name, shape);
    return contiguous<float>(array);
}

Array<int32_t> int_array(py::handle value, const std::string& name, std::initializer_list<py::ssize_t> shape) {
    const py::array array = require_array(value, name);
    if (!holds<int32_t>(array))
        wrong_type(array, name, "int32");
    require_shape(array, name, shape);
    return contiguous<int32_t>(array);
}

Array<uint32_t> triangle_array(py::handle value, const std::string& name, size_t vertices) {
    const py::array array = require_array(value, name);
    const bool is_signed = holds<int32_t>(array);
    if (!is_signed && !holds<uint32_t>(array))
        wrong_type(array, name, "int32 or uint32");
    require_shape(array, name, {kAny, 3});
    // A negative index, seen without its sign, is larger than any vertex count.
    Array<uint32_t> triangles =
        contiguous<uint32_t>(is_signed ? py::array(contiguous<int32_t>(array).owner.attr("view")("uint32")) : array);
    const std::span<const uint32_t> indices = triangles.span();
    uint32_t largest = 0;
    for (const uint32_t index : indices)
        largest = std::max(largest, index);
    if (!indices.empty() && largest >= vertices) {
        const auto at = static_cast<size_t>(std::find(indices.begin(), indices.end(), largest) - indices.begin());
        const std::string shown = is_signed ? std::to_string(static_cast<int32_t>(largest)) : std::to_string(largest);
        throw py::index_error(name + ": triangle " + std::to_string(at / 3) + " has vertex index " + shown +
                              ", but there are " + std::to_string(vertices) + " vertices");
    }
    return triangles;
}

Matrix4 matrix_from(py::handle value, const std::string& name) {
    const auto array = py::array_t<double, py::array::c_style | py::array::forcecast>::ensure(value);
    if (!array) {
        PyErr_Clear();
        throw py::type_error(name + " must be a 4x4 matrix of numbers");
    }
    require_shape(array, name, {4, 4});
    Matrix4 matrix;
    for (py::ssize_t row = 0; row < 4; ++row) {
        for (py::ssize_t column = 0; column < 4; ++column) {
            matrix.rows[static_cast<size_t>(row)][static_cast<size_t>(column)] = array.at(row, column);
        }
    }
    return matrix;
}

int checked_threads(int threads, const std::string& name) {
    if (threads < 0 || threads > kMaxThreads) {
        throw py::value_error(name + " must be between 0 (all) and " + std::to_string(kMaxThreads) + ", not " +
                              std::to_string(threads));
    }
    return threads;
}

}  // namespace espalier
