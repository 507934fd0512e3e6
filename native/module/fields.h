// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <pybind11/pybind11.h>

#include <string>
#include <utility>

namespace espalier {

/// The entries of a Python dict, read with errors that say which dict and which entry.
class Fields {
 public:
    /// `place` is what errors call the dict.
    Fields(pybind11::handle value, std::string place) : place_(std::move(place)) {
        if (!pybind11::isinstance<pybind11::dict>(value))
            throw pybind11::type_error(place_ + " must be a dict");
        dict_ = pybind11::reinterpret_borrow<pybind11::dict>(value);
    }
    Fields(pybind11::handle value, const std::string& list, size_t index)
        : Fields(value, list + "[" + std::to_string(index) + "]") {}

    const std::string& place() const { return place_; }

    /// The entry, or None where there is none.
    pybind11::object find(const char* key) const {
        return dict_.contains(key) ? pybind11::object(dict_[key]) : pybind11::none();
    }

    pybind11::object at(const char* key) const {
        if (!dict_.contains(key))
            throw pybind11::value_error(place_ + " has no entry '" + key + "'");
        return dict_[key];
    }

    template <class T>
    T required(const char* key) const {
        return convert<T>(at(key), key);
    }

    template <class T>
    T value_or(const char* key, T fallback) const {
        return dict_.contains(key) ? convert<T>(dict_[key], key) : std::move(fallback);
    }

 private:
    template <class T>
    T convert(const pybind11::object& value, const char* key) const {
        try {
            return value.cast<T>();
        } catch (const pybind11::cast_error&) {
            throw pybind11::type_error(place_ + ": entry '" + key + "' cannot be " +
                                       std::string(pybind11::repr(value)));
        }
    }

    std::string place_;
    pybind11::dict dict_;
};

}  // namespace espalier
