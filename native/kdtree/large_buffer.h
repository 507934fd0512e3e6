// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <sys/mman.h>

#include <cstddef>
#include <new>
#include <span>
#include <type_traits>
#include <utility>

namespace espalier {

/// Room for `capacity` items straight from the operating system, in huge pages where that pays. Memory is taken only
/// when it is first written. Items start as zero bytes.
template <class T>
class LargeBuffer {
    static_assert(std::is_trivially_copyable_v<T>);

 public:
    LargeBuffer() = default;
    explicit LargeBuffer(size_t capacity) : capacity_(capacity) {
        if (capacity == 0) {
            return;
        }
        void* memory =
            ::mmap(nullptr, bytes(), PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
        if (memory == MAP_FAILED) {
            throw std::bad_alloc();
        }
        if (bytes() >= kHugePagesFrom) {
            ::madvise(memory, bytes(), MADV_HUGEPAGE);
        }
        data_ = static_cast<T*>(memory);
    }
    LargeBuffer(LargeBuffer&& other) noexcept
        : data_(std::exchange(other.data_, nullptr)), capacity_(std::exchange(other.capacity_, 0)) {}
    LargeBuffer& operator=(LargeBuffer&& other) noexcept {
        std::swap(data_, other.data_);
        std::swap(capacity_, other.capacity_);
        return *this;
    }
    ~LargeBuffer() {
        if (data_ != nullptr) {
            ::munmap(data_, bytes());
        }
    }

    T* data() { return data_; }
    const T* data() const { return data_; }
    size_t size() const { return capacity_; }
    size_t bytes() const { return capacity_ * sizeof(T); }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }
    std::span<const T> span() const { return {data_, capacity_}; }

 private:
    static constexpr size_t kHugePagesFrom =
        size_t{4} << 20;  ///< below, clearing the rest of the last page costs more than it saves
    T* data_ = nullptr;
    size_t capacity_ = 0;
};

}  // namespace espalier
