// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <sys/mman.h>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>
#include <span>
#include <type_traits>
#include <utility>

namespace espalier {

class BuildMemory;

/// Takes the pages that begin among these items now, which costs half of what taking small ones at the first write to
/// each does. A system that cannot will take them later.
template <class T>
void take_pages(T* begin, T* end) {
    constexpr int kPopulateWrite = 23;  // MADV_POPULATE_WRITE, Linux 5.14
    constexpr uintptr_t kPage = 4096;   // the smallest of any system
    auto* first = reinterpret_cast<std::byte*>(begin) + (0 - reinterpret_cast<uintptr_t>(begin)) % kPage;
    if (const auto* last = reinterpret_cast<std::byte*>(end); first < last) {
        ::madvise(first, static_cast<size_t>(last - first), kPopulateWrite);
    }
}

/// Room for `capacity` items straight from the operating system. Memory is taken only when it is first written, in huge
/// pages where they pay: a fault costs several times what clearing its 4 KiB does. Items in fresh memory start as
/// zero bytes.
template <class T>
class LargeBuffer {
    static_assert(std::is_trivially_copyable_v<T>);

 public:
    static constexpr size_t kHugePage = size_t{2} << 20;

    LargeBuffer() = default;
    /// expected_bytes: how much is usually used of a room that is larger than it needs to be.
    explicit LargeBuffer(size_t capacity, size_t expected_bytes = SIZE_MAX) : capacity_(capacity) {
        if (capacity == 0) {
            return;
        }
        if (capacity > SIZE_MAX / 2 / sizeof(T)) {
            throw std::bad_alloc();
        }
        const size_t huge = kHugePage * huge_pages(std::min(bytes(), expected_bytes));
        mapped_ = std::max(bytes(), huge) + (huge != 0 ? kHugePage : 0);
        void* memory =
            ::mmap(nullptr, mapped_, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
        if (memory == MAP_FAILED) {
            throw std::bad_alloc();
        }
        mapping_ = memory;
        if (huge != 0) {
            size_t space = mapped_;
            std::align(kHugePage, huge, memory, space);
        }
        data_ = static_cast<T*>(memory);
        expect_use(expected_bytes);
    }
    LargeBuffer(LargeBuffer&& other) noexcept { *this = std::move(other); }
    LargeBuffer& operator=(LargeBuffer&& other) noexcept {
        std::swap(data_, other.data_);
        std::swap(capacity_, other.capacity_);
        std::swap(mapping_, other.mapping_);
        std::swap(mapped_, other.mapped_);
        return *this;
    }
    ~LargeBuffer() {
        if (mapping_ != nullptr) {
            ::munmap(mapping_, mapped_);
        }
    }

    /// How many of them so many bytes are worth: a tail too short for one of its own is left to small ones.
    static size_t huge_pages(size_t bytes) { return (bytes + kHugePage - kHugePagesFrom) / kHugePage; }

    /// The same memory for other items, whatever it holds, or fresh memory if they need more. What they do not need is
    /// given back: with what it was taken from the front of, if that is all still there.
    template <class U>
    LargeBuffer<U> reuse_for(size_t capacity, LargeBuffer<std::byte>& behind) && {
        if (capacity == 0 || capacity * sizeof(U) > bytes()) {
            return LargeBuffer<U>(capacity);
        }
        LargeBuffer<U> reused;
        reused.data_ = reinterpret_cast<U*>(std::exchange(data_, nullptr));
        reused.capacity_ = capacity;
        auto* mapping = static_cast<std::byte*>(std::exchange(mapping_, nullptr));
        const auto needed = static_cast<size_t>(reinterpret_cast<std::byte*>(reused.data_ + capacity) - mapping);
        const size_t kept = std::min((needed + kPage - 1) / kPage * kPage, mapped_);
        reused.mapping_ = mapping;
        reused.mapped_ = kept;
        if (mapping + mapped_ == behind.mapping_) {
            behind.mapping_ = mapping + kept;
            behind.mapped_ += mapped_ - kept;
        } else if (kept < mapped_) {
            ::munmap(mapping + kept, mapped_ - kept);
        }
        capacity_ = mapped_ = 0;
        return reused;
    }

    /// Takes the pages of items [begin, end) now (see above).
    void take_pages(size_t begin, size_t end) { espalier::take_pages(data_ + begin, data_ + std::min(end, capacity_)); }
    void take_huge_page(size_t page) {
        constexpr size_t kItems = kHugePage / sizeof(T);
        take_pages(page * kItems, (page + 1) * kItems);
    }

    T* data() { return data_; }
    const T* data() const { return data_; }
    size_t size() const { return capacity_; }
    size_t bytes() const { return capacity_ * sizeof(T); }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }
    std::span<const T> span() const { return {data_, capacity_}; }

 private:
    template <class U>
    friend class LargeBuffer;
    friend class BuildMemory;
    static constexpr size_t kPage = size_t{64} << 10;  ///< the largest small page of any system
    /// From here on clearing the rest of a huge page costs no more than small pages do, and little memory is wasted.
    static constexpr size_t kHugePagesFrom = size_t{768} << 10;

    /// Parts with so many items at the front, and what is left until the next huge page, which must begin in it.
    LargeBuffer take_front(size_t capacity) {
        const auto end = reinterpret_cast<uintptr_t>(data_ + capacity);
        const size_t taken = std::min(capacity + (0 - end) % kHugePage / sizeof(T), capacity_);
        LargeBuffer front;
        front.data_ = std::exchange(data_, data_ + taken);
        front.capacity_ = taken;
        capacity_ -= taken;
        front.mapping_ = std::exchange(mapping_, data_);
        front.mapped_ =
            static_cast<size_t>(static_cast<std::byte*>(mapping_) - static_cast<std::byte*>(front.mapping_));
        mapped_ -= front.mapped_;
        return front;
    }

    /// Asks for huge pages for so many bytes of memory that begins with one.
    void expect_use(size_t expected_bytes) {
        if (const size_t huge = kHugePage * huge_pages(std::min(bytes(), expected_bytes)); huge != 0) {
            ::madvise(data_, huge, MADV_HUGEPAGE);
        }
    }

    T* data_ = nullptr;
    size_t capacity_ = 0;
    void* mapping_ = nullptr;  ///< null also where the memory is another's
    size_t mapped_ = 0;
};

/// Memory of a build: at its front what is later kept, in part; behind that buffers that lie side by side, so that huge
/// pages hold many small ones. All that is not kept is given back together: whenever a piece is given back, all
/// processors that use the process's memory have to be told, and wait.
class BuildMemory {
 public:
    /// In bytes; usual: how much of it will usually be used.
    struct Size {
        size_t most;
        size_t usual;
    };
    BuildMemory(Size front, size_t usual_behind)
        : memory_(front.most + LargeBuffer<std::byte>::kHugePage + std::max(kLeastBytes, 2 * usual_behind),
                  front.usual),
          front_(memory_.take_front(front.most)),
          begin_(front_.data()),
          used_end_(begin_ + std::min(front.usual, front_.bytes())),
          huge_pages_(LargeBuffer<std::byte>::huge_pages(usual_behind)) {
        memory_.expect_use(usual_behind);
    }

    /// The front, which may outlive this.
    template <class T>
    LargeBuffer<T> take_front() {
        const size_t capacity = front_.bytes() / sizeof(T);
        return keep<T>(std::move(front_), capacity);
    }
    /// Of the front, whatever it holds, so many items for what the tree keeps; or as many in fresh memory where it is
    /// too small, and then nothing of it.
    template <class T, class U>
    LargeBuffer<T> keep(LargeBuffer<U> front, size_t capacity) {
        LargeBuffer<T> kept = std::move(front).template reuse_for<T>(capacity, memory_);
        if (reinterpret_cast<const std::byte*>(kept.data()) != begin_) {
            used_end_ = begin_;
        }
        return kept;
    }

    /// Next to what was kept of the front, if so many items fit between that and what is usually used, else in fresh
    /// memory.
    template <class T>
    LargeBuffer<T> keep_more(size_t capacity) {
        auto* begin = static_cast<std::byte*>(memory_.mapping_);
        constexpr size_t kPage = LargeBuffer<T>::kPage;
        const size_t bytes = (capacity * sizeof(T) + kPage - 1) / kPage * kPage;
        if (begin >= used_end_ || bytes > static_cast<size_t>(used_end_ - begin)) {
            return LargeBuffer<T>(capacity);
        }
        LargeBuffer<T> kept;
        kept.data_ = reinterpret_cast<T*>(begin);
        kept.capacity_ = capacity;
        kept.mapping_ = begin;
        kept.mapped_ = bytes;
        memory_.mapping_ = begin + bytes;
        memory_.mapped_ -= bytes;
        return kept;
    }
    /// Whether these items lie where pages were usually taken when the front was in use.
    template <class T>
    bool has_pages(const LargeBuffer<T>& kept) const {
        const auto* begin = reinterpret_cast<const std::byte*>(kept.data());
        return begin >= begin_ && begin + kept.bytes() <= used_end_;
    }

    /// What it returns must be destroyed before this. Any thread may call it, unlike those above.
    template <class T>
    LargeBuffer<T> take(size_t capacity) {
        constexpr size_t kLine = 64;
        if (capacity < memory_.size() / sizeof(T)) {
            const size_t bytes = (capacity * sizeof(T) + kLine - 1) / kLine * kLine;
            const size_t place = used_.fetch_add(bytes, std::memory_order_relaxed);
            if (place + bytes <= memory_.size()) {
                LargeBuffer<T> taken;
                taken.data_ = reinterpret_cast<T*>(memory_.data() + place);
                taken.capacity_ = capacity;
                return taken;
            }
        }
        return LargeBuffer<T>(capacity);
    }

    /// Behind the front it has so many huge pages, which are taken when they are first written to, or now.
    size_t huge_pages() const { return huge_pages_; }
    void take_huge_page(size_t page) { memory_.take_huge_page(page); }

 private:
    static constexpr size_t kLeastBytes = size_t{64} << 20;  ///< of addresses, not of memory
    LargeBuffer<std::byte> memory_;
    LargeBuffer<std::byte> front_;
    const std::byte* begin_;     ///< of the front
    const std::byte* used_end_;  ///< of what is usually used of it
    size_t huge_pages_;          ///< behind the front
    std::atomic<size_t> used_{0};
};

}  // namespace espalier
