// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/top_levels.h"

#include <algorithm>

#include "kdtree/parallel.h"

namespace espalier {
namespace {

constexpr size_t kPageWords = LargeBuffer<uint32_t>::kHugePage / sizeof(uint32_t);

/// Small enough to share out among the threads and for the cache of one, large enough that a segment is still worth a
/// vector loop a few levels down.
uint32_t choose_segment_size(uint32_t triangles, int threads) {
    const uint32_t most = std::max<uint32_t>(8192, triangles / 128);
    return std::clamp<uint32_t>(triangles / (16 * static_cast<uint32_t>(threads)), 1024, most);
}

/// Segments keep a quarter of their size free, so that most right halves fit behind their left ones although straddlers
/// go to both. Vector code may touch up to kMargin items behind the last one, which must then be no other segment's.
constexpr uint32_t kMargin = 16;
uint32_t with_slack(uint32_t count) { return count + count / 4 + 2 * kMargin; }

/// References that the top usually makes, and what all threads take to partition them.
size_t places_of_top(uint32_t triangles, int threads) {
    const size_t segment = with_slack(choose_segment_size(triangles, threads));
    return triangles + 2 * segment * static_cast<size_t>(threads + 1);
}

/// And those of subtrees, if they follow in the same memory.
size_t places_of_all(uint32_t triangles, int threads) {
    return places_of_top(triangles, threads) + size_t{3} * triangles / 2;
}

ReferenceBuffer memory_for(uint32_t triangles, int threads, BuildMemory* memory) {
    if (memory == nullptr) {
        return ReferenceBuffer(places_of_top(triangles, threads) + triangles / 8);
    }
    return {places_of_all(triangles, threads), memory->take_front<uint32_t>()};
}

void add(const BinCounts& part, BinCounts& sum) {
    for (int axis = 0; axis < 3; ++axis) {
        for (int j = 0; j < kPlanes; ++j) {
            sum.left[axis][j] += part.left[axis][j];
            sum.ends_before[axis][j] += part.ends_before[axis][j];
        }
    }
}

}  // namespace

size_t TopLevels::reference_bytes(uint32_t triangles, int threads) {
    return ReferenceBuffer::bytes_for(places_of_all(triangles, threads));
}

References SegmentMemory::take(uint32_t count) {
    const std::lock_guard lock(mutex_);
    if (used_ + count > buffers_.back().capacity()) {
        buffers_.emplace_back(std::max<size_t>(buffers_.front().capacity() / 2, count));
        used_ = 0;
    }
    used_ += count;
    return buffers_.back().references().at(used_ - count);
}

TopLevels::TopLevels(const TriangleSoup& soup, const BuildParameters& parameters, const std::atomic<bool>* cancel,
                     int threads, BuildMemory* memory)
    : soup_(soup),
      parameters_(parameters),
      cancel_(cancel),
      threads_(threads),
      kernels_(build_kernels()),
      is_large_(is_large(soup, parameters)),
      segment_size_(choose_segment_size(soup.size(), threads)),
      build_memory_(memory),
      memory_(memory_for(soup.size(), threads, memory)),
      first_places_(memory_.first()),
      words_in_use_(
          std::max(memory == nullptr ? 0 : usual_block_bytes(soup.size()) / sizeof(uint32_t), first_places_.words())),
      scratch_(static_cast<size_t>(threads)) {}

void TopLevels::make_references() {
    if (is_large_ && sort_root()) {
        return;
    }
    const uint32_t triangles = soup_.size();
    const size_t count = (triangles + segment_size_ - 1) / segment_size_;
    std::vector<Box3f> bounds(count);
    std::vector<RejectedFaces> rejected(count);
    TopNode root{};
    root.segments.resize(count);
    // Pages come first, but nobody waits for the last of them, where no references lie but in the smallest scenes.
    const size_t pages = is_large_ ? 0 : page_count();
    parallel_for(threads_, pages + count, [&](size_t task) {
        if (task < pages) {
            take_page(task);
            return;
        }
        const size_t i = task - pages;
        const auto begin = static_cast<uint32_t>(i * segment_size_);
        const uint32_t end = std::min(begin + segment_size_, triangles);
        const uint32_t capacity = with_slack(segment_size_);
        const References place = memory_.take(capacity);
        root.segments[i] = {place, kernels_.make_references(soup_, begin, end, place, bounds[i], rejected[i]),
                            capacity};
    });

    Box3f box;
    uint32_t valid = 0;
    for (size_t i = 0; i < count; ++i) {
        box.extend(bounds[i]);
        valid += root.segments[i].count;
        rejected_ += rejected[i];
    }
    root.node = {box, box, valid, spare_references(triangles), 0};
    nodes_.push_back(std::move(root));
}

/// The few huge pages behind the references of a small build, which threads share; of a large one's, many may not be
/// needed.
size_t TopLevels::pages_behind() const {
    const size_t pages = build_memory_ == nullptr ? 0 : build_memory_->huge_pages();
    return pages <= static_cast<size_t>(threads_) ? pages : 0;
}

size_t TopLevels::pages_of_references() const { return words_in_use_ / kPageWords + 1; }

/// Every thread takes pages of its own: two that first wrote to one page at the same time would both clear it.
void TopLevels::take_page(size_t page) {
    if (page >= pages_of_references()) {
        build_memory_->take_huge_page(page - pages_of_references());
        return;
    }
    const size_t begin = page * kPageWords;
    first_places_.memory().take_pages(begin, std::min(words_in_use_, begin + kPageWords));
}

/// False if a sample has no plane for that, or if so many faces straddle its planes that they are not worth it.
bool TopLevels::sort_root() {
    size_t pages = page_count();
    for (Box3f bounds = bound_vertices();; bounds = root_.node.cell) {
        root_ = {};
        rejected_ = {};
        root_.split = choose_multiway_split(bounds, pages);
        pages = 0;
        if (root_.split.leaves == 1) {
            return false;
        }
        sort_faces();
        if (!root_.add_up()) {
            root_ = {};
            rejected_ = {};
            return false;
        }
        if (bounds == root_.node.cell || !root_.has_plane_in_upper_end()) {
            break;  // or it is planned anew within the box of the faces, where no plane lies in its ends
        }
    }
    add_nodes(root_.split.root, root_.node.cell, 0);
    return true;
}

/// Larger than the box of the faces if some vertices have none, but known before they are.
Box3f TopLevels::bound_vertices() const {
    constexpr size_t kVertices = 16384;
    const size_t vertices = soup_.positions.size() / 3;
    std::vector<Box3f> boxes((vertices + kVertices - 1) / kVertices);
    parallel_for(threads_, boxes.size(), [&](size_t i) {
        boxes[i] = kernels_.bound_vertices(soup_, i * kVertices, std::min(vertices, (i + 1) * kVertices));
    });
    Box3f bounds;
    for (const Box3f& box : boxes) {
        bounds.extend(box);
    }
    return bounds;
}

/// While one thread plans it, the others take the first so many pages.
MultiwaySplit TopLevels::choose_multiway_split(const Box3f& bounds, size_t pages) {
    const uint32_t triangles = soup_.size();
    const uint32_t shift = sampling_shift(triangles);
    const ReferenceBuffer sample(sample_room((triangles >> shift) + kChunk));
    // All threads together, each chunk where it would be if no face before it were faulty.
    const size_t chunks = (triangles + kChunk - 1) / kChunk;
    const uint32_t most = kChunk >> shift;
    std::vector<uint32_t> taken(chunks);
    parallel_for(threads_, chunks, [&](size_t i) {
        taken[i] = kernels_.sample_faces(soup_, static_cast<uint32_t>(i), shift, sample.references().at(i * most));
    });
    uint32_t sampled = 0;
    for (size_t i = 0; i < chunks; ++i) {
        if (sampled != i * most) {
            copy_references(sample.references().at(i * most), taken[i], sample.references().at(sampled));
        }
        sampled += taken[i];
    }
    const OpenNode root{bounds, bounds, triangles, spare_references(triangles), 0};
    MultiwaySplit split;
    parallel_for(threads_, 1 + pages, [&](size_t i) {
        if (i == 0) {
            split = kernels_.choose_multiway_split(soup_, root, sample.references(), sampled, parameters_);
        } else {
            take_page(i - 1);
        }
    });
    return split;
}

void TopLevels::sort_faces() {
    const uint32_t triangles = soup_.size();
    const size_t count = (triangles + kChunk - 1) / kChunk;
    constexpr size_t kUsual = kChunk + kChunk / 2;
    struct Worker {
        References places;
        size_t room = 0;
        ReferenceBuffer scratch;
        Box3f bounds;
        RejectedFaces rejected;
        uint32_t valid = 0;
    };
    std::vector<Worker> workers(static_cast<size_t>(threads_));
    root_.chunks.resize(count);
    std::atomic<uint64_t> total{0};
    parallel_for(threads_, count, [&](size_t i, int number) {
        if (total.load(std::memory_order_relaxed) > triangles + spare_references(triangles)) {
            return;  // too many already: what a sample that misleads may take is bounded
        }
        if (cancel_ != nullptr && cancel_->load(std::memory_order_relaxed)) {
            throw BuildCancelled();
        }
        Worker& worker = workers[static_cast<size_t>(number)];
        if (worker.scratch.references().triangle == nullptr) {
            worker.scratch = ReferenceBuffer(SortedChunk::kScratch, 0);
        }
        const auto begin = static_cast<uint32_t>(i) * kChunk;
        const References made = worker.scratch.references();
        const uint32_t valid = kernels_.make_references(soup_, begin, std::min(begin + kChunk, triangles), made,
                                                        worker.bounds, worker.rejected);
        worker.valid += valid;
        for (size_t wanted = kUsual;;) {
            if (worker.room < wanted) {
                worker.room = std::max(wanted, 8 * kUsual);
                worker.places = memory_.take(static_cast<uint32_t>(worker.room));
            }
            root_.chunks[i].places = worker.places;
            wanted = kernels_.sort_by_leaves(soup_, root_.split, made, valid, parameters_.clip,
                                             made.at(kChunk + SortedChunk::kMargin), worker.room, root_.chunks[i]);
            if (wanted <= worker.room) {
                total.fetch_add(root_.chunks[i].total(), std::memory_order_relaxed);
                worker.places = worker.places.at(wanted);
                worker.room -= wanted;
                return;
            }
        }
    });
    Box3f box;
    uint32_t valid = 0;
    for (const Worker& worker : workers) {
        box.extend(worker.bounds);
        valid += worker.valid;
        rejected_ += worker.rejected;
    }
    root_.node = {box, box, valid, spare_references(triangles), 0};
}

/// Appends the nodes of the multiway split below a child; returns the index of the first.
uint32_t TopLevels::add_nodes(uint32_t child, const Box3f& cell, int depth) {
    const auto index = static_cast<uint32_t>(nodes_.size());
    nodes_.emplace_back();
    child = root_.skip_planes_beside(cell, child);
    if (MultiwaySplit::is_leaf(child)) {
        TopNode& leaf = nodes_[index];
        leaf.node = root_.leaf(child, cell, depth);
        for (const SortedChunk& chunk : root_.chunks) {
            if (const uint32_t count = chunk.count[child]; count != 0) {
                leaf.segments.push_back({chunk.places.at(chunk.begin[child]), count, count});
            }
        }
        return index;
    }
    const MultiwaySplit::Branch& branch = root_.split.branch(child);
    const auto [left_cell, right_cell] = halves(cell, branch.split);
    const uint32_t left = add_nodes(branch.child[0], left_cell, depth + 1);
    const uint32_t right = add_nodes(branch.child[1], right_cell, depth + 1);
    TopNode& node = nodes_[index];
    node.node = {cell, nodes_[left].node.tight, nodes_[left].node.count + nodes_[right].node.count, 0, depth};
    node.node.tight.extend(nodes_[right].node.tight);
    node.split = branch.split;
    node.left = left;
    node.right = right;
    return index;
}

std::vector<TopLevels::Part> TopLevels::parts_of(const std::vector<uint32_t>& nodes) const {
    std::vector<Part> parts;
    for (const uint32_t node : nodes) {
        for (uint32_t i = 0; i < nodes_[node].segments.size(); ++i) {
            parts.push_back({node, i});
        }
    }
    return parts;
}

void TopLevels::split_above(uint32_t cut) {
    if (is_large_) {
        return;  // what is left to do is done best where one thread splits depth first
    }
    std::vector<uint32_t> level{0};
    for (;;) {
        std::erase_if(level,
                      [&](uint32_t node) { return nodes_[node].node.count <= std::max(cut, parameters_.one_thread); });
        if (level.empty()) {
            return;
        }
        if (cancel_ != nullptr && cancel_->load(std::memory_order_relaxed)) {
            throw BuildCancelled();
        }
        const std::vector<Part> parts = parts_of(level);
        choose_splits(level, parts);
        level = open_level(level, parts);
    }
}

void TopLevels::choose_splits(const std::vector<uint32_t>& level, const std::vector<Part>& parts) {
    count_parts(parts, [&](const TopNode& top, const Segment& segment, BinCounts& counts) {
        kernels_.count_bins(top.node, segment.references, segment.count, counts);
    });
    for_each_node(level, [&](TopNode& top, BinCounts& counts) {
        top.split = kernels_.choose_split(top.node, counts, parameters_);
    });
    if (parameters_.search == Search::kSlices) {
        return;
    }
    count_parts(parts, [&](const TopNode& top, const Segment& segment, BinCounts& counts) {
        if (Interval range; finer_range(top.node, top.split, range)) {
            kernels_.count_bins_along(top.split.axis, range, segment.references, segment.count, counts);
        }
    });
    for_each_node(level, [&](TopNode& top, BinCounts& counts) {
        if (Interval range; finer_range(top.node, top.split, range)) {
            top.split = kernels_.choose_finer_split(top.node, top.split, range, counts, parameters_);
        }
    });
}

template <class F>
void TopLevels::count_parts(const std::vector<Part>& parts, const F& count) {
    counts_.resize(parts.size());
    parallel_for(threads_, parts.size(), [&](size_t i) {
        const TopNode& top = nodes_[parts[i].node];
        counts_[i] = {};
        count(top, top.segments[parts[i].segment], counts_[i]);
    });
}

template <class F>
void TopLevels::for_each_node(const std::vector<uint32_t>& level, const F& choose) {
    size_t first = 0;
    for (const uint32_t node : level) {
        TopNode& top = nodes_[node];
        BinCounts sum{};
        for (const size_t end = first + top.segments.size(); first < end; ++first) {
            add(counts_[first], sum);
        }
        choose(top, sum);
    }
}

Partition TopLevels::partition_segment(const TopNode& top, const Segment& segment, const References& scratch,
                                       Segment& left, Segment& right) {
    const Partition parts = kernels_.partition(soup_, segment.references, segment.count, top.split, parameters_.clip,
                                               segment.references, scratch);
    const uint32_t both = parts.left_count + parts.right_count;
    if (both + 2 * kMargin <= segment.capacity) {
        // What is free goes to both by their size: many a split takes but little off a node.
        const uint64_t free = segment.capacity - both - 2 * kMargin;
        const uint32_t left_capacity =
            parts.left_count + kMargin + static_cast<uint32_t>(free * parts.left_count / std::max(both, 1U));
        left = {segment.references, parts.left_count, left_capacity};
        right = {segment.references.at(left_capacity), parts.right_count, segment.capacity - left_capacity};
    } else {
        const uint32_t capacity = with_slack(parts.right_count);
        left = {segment.references, parts.left_count, segment.capacity};
        right = {memory_.take(capacity), parts.right_count, capacity};
    }
    copy_references(scratch, parts.right_count, right.references);
    return parts;
}

std::vector<uint32_t> TopLevels::open_level(const std::vector<uint32_t>& level, const std::vector<Part>& parts) {
    std::vector<Partition> results(parts.size());
    std::vector<Segment> left(parts.size());
    std::vector<Segment> right(parts.size());
    parallel_for(threads_, parts.size(), [&](size_t i, int worker) {
        const TopNode& top = nodes_[parts[i].node];
        Partition whole;
        if (!top.is_split() || cuts_empty_space(top.node, top.split, whole)) {
            return;
        }
        References& mine = scratch_[static_cast<size_t>(worker)];
        if (mine.triangle == nullptr) {
            mine = memory_.take(2 * with_slack(segment_size_));
        }
        results[i] = partition_segment(top, top.segments[parts[i].segment], mine, left[i], right[i]);
    });

    std::vector<uint32_t> next;
    size_t first = 0;
    for (const uint32_t index : level) {
        const size_t end = first + nodes_[index].segments.size();
        if (nodes_[index].is_split()) {
            TopNode left_child{};
            TopNode right_child{};
            Partition whole;
            if (cuts_empty_space(nodes_[index].node, nodes_[index].split, whole)) {
                (whole.left_count == 0 ? right_child : left_child).segments = std::move(nodes_[index].segments);
            } else {
                for (size_t i = first; i < end; ++i) {
                    whole.left_count += results[i].left_count;
                    whole.right_count += results[i].right_count;
                    whole.left_tight.extend(results[i].left_tight);
                    whole.right_tight.extend(results[i].right_tight);
                    left_child.segments.push_back(left[i]);
                    right_child.segments.push_back(right[i]);
                }
            }
            open_children(nodes_[index].node, nodes_[index].split, whole, left_child.node, right_child.node);
            nodes_[index].segments.clear();
            nodes_[index].left = static_cast<uint32_t>(nodes_.size());
            nodes_[index].right = nodes_[index].left + 1;
            next.push_back(nodes_[index].left);
            next.push_back(nodes_[index].right);
            nodes_.push_back(std::move(left_child));
            nodes_.push_back(std::move(right_child));
        }
        first = end;
    }
    return next;
}

void gather(const TopNode& node, const References& to) {
    size_t place = 0;
    for (const Segment& segment : node.segments) {
        copy_references(segment.references, segment.count, to.at(place));
        place += segment.count;
    }
}

}  // namespace espalier
