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
        const size_t pages = huge_pages(std::min(bytes(), expected_bytes));
        const size_t huge = kHugePage * pages;
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
        ask_for_huge_pages(pages);
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
    friend class BuildMemory;
    /// From here on clearing the rest of a huge page costs no more than small pages do, and little memory is wasted.
    static constexpr size_t kHugePagesFrom = size_t{768} << 10;

    /// So many, from where its items begin, which must be where such a page does.
    void ask_for_huge_pages(size_t pages) {
        if (pages != 0) {
            ::madvise(data_, pages * kHugePage, MADV_HUGEPAGE);
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
        : memory_(front.most + kHugePage + std::max(kLeastBytes, 2 * usual_behind), front.usual),
          begin_(memory_.data_),
          huge_pages_(LargeBuffer<std::byte>::huge_pages(usual_behind)) {
        // The front ends where a huge page begins.
        const size_t most = front.most + (0 - reinterpret_cast<uintptr_t>(begin_ + front.most)) % kHugePage;
        used_end_ = begin_ + std::min(front.usual, most);
        memory_.data_ += most;
        memory_.capacity_ -= most;
        memory_.ask_for_huge_pages(huge_pages_);
    }

    /// The front, which may outlive this.
    template <class T>
    LargeBuffer<T> take_front() {
        return part_with<T>(begin_, static_cast<size_t>(memory_.data_ - begin_) / sizeof(T));
    }
    /// Of the front that was taken, whatever it holds, so many items for what the tree keeps; or as many in fresh
    /// memory where it is too small, and then nothing of it.
    template <class T, class U>
    LargeBuffer<T> keep(LargeBuffer<U> front, size_t capacity) {
        if (capacity == 0 || capacity * sizeof(T) > front.bytes()) {
            used_end_ = begin_;
            return LargeBuffer<T>(capacity);
        }
        memory_.mapping_ = std::exchange(front.mapping_, nullptr);
        memory_.mapped_ += front.mapped_;
        return part_with<T>(begin_, capacity);
    }

    /// Next to what was kept of the front, if so many items fit between that and what is usually used, else in fresh
    /// memory.
    template <class T>
    LargeBuffer<T> keep_more(size_t capacity) {
        auto* begin = static_cast<std::byte*>(memory_.mapping_);
        if (begin + whole_pages(capacity * sizeof(T)) > used_end_) {
            return LargeBuffer<T>(capacity);
        }
        return part_with<T>(begin, capacity);
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
    static constexpr size_t kHugePage = LargeBuffer<std::byte>::kHugePage;
    static constexpr size_t kLeastBytes = size_t{64} << 20;  ///< of addresses, not of memory

    static size_t whole_pages(size_t bytes) {
        constexpr size_t kPage = size_t{64} << 10;  // the largest small page of any system
        return (bytes + kPage - 1) / kPage * kPage;
    }

    /// Items that lie at `data`, in or at the beginning of the mapping, which from then on begins behind them.
    template <class T>
    LargeBuffer<T> part_with(std::byte* data, size_t capacity) {
        auto* mapping = static_cast<std::byte*>(memory_.mapping_);
        const auto needed = static_cast<size_t>(data + capacity * sizeof(T) - mapping);
        LargeBuffer<T> kept;
        kept.data_ = reinterpret_cast<T*>(data);
        kept.capacity_ = capacity;
        kept.mapping_ = mapping;
        kept.mapped_ = std::min(whole_pages(needed), static_cast<size_t>(memory_.data_ - mapping));
        memory_.mapping_ = mapping + kept.mapped_;
        memory_.mapped_ -= kept.mapped_;
        return kept;
    }

    LargeBuffer<std::byte> memory_;  ///< its items lie behind the front, its mapping begins with what is not kept of it
    std::byte* const begin_;         ///< of the front
    const std::byte* used_end_;      ///< of what is usually used of it
    const size_t huge_pages_;        ///< behind the front
    std::atomic<size_t> used_{0};
};

}  // namespace espalier
