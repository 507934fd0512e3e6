// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/subtrees.h"

#include <algorithm>
#include <stdexcept>

#include "kdtree/parallel.h"

namespace espalier {

void Subtrees::add_whole(const OpenNode& root, ReferenceBuffer references) {
    Subtree& subtree = subtrees_.emplace_back();
    subtree.root = root;
    subtree.is_gathered = true;
    own_references_ = std::move(references);
    references_ = own_references_.references();
    rooms_.push_back({root.count, own_references_.capacity()});
    waiting_.push_back(&subtree);
}

void Subtrees::add_sorted(TopLevels& top) {
    Subtree& subtree = subtrees_.emplace_back();
    subtree.root = top.nodes()[0].node;
    subtree.is_gathered = true;
    const auto [memory, used] = top.memory();
    references_ = memory.references();
    rooms_.push_back({used, memory.capacity()});
    sorted_ = top.sorted_root();
    waiting_.push_back(&subtree);
}

void Subtrees::add_below(TopLevels& top) {
    for (const TopNode& node : top.nodes()) {
        if (!node.is_split()) {
            Subtree& subtree = subtrees_.emplace_back();
            subtree.root = node.node;
            subtree.top = &node;
            waiting_.push_back(&subtree);
        }
    }
    std::stable_sort(waiting_.begin(), waiting_.end(),
                     [](const Subtree* a, const Subtree* b) { return a->root.count > b->root.count; });
    gather_all(top);
}

/// Lays the references of each subtree side by side behind those of the top levels, whose places then become rooms,
/// or in memory of their own where there are too few places. Sorted ones are left to the thread that takes the subtree,
/// in whose cache they then are.
void Subtrees::gather_all(TopLevels& top) {
    constexpr size_t kMargin = ReferenceBuffer::kSlack;
    const auto threads = static_cast<size_t>(threads_);
    size_t count = 0;
    for (const Subtree& subtree : subtrees_) {
        count += subtree.root.count + kMargin;
    }
    const auto [memory, used] = top.memory();
    references_ = memory.references();
    const uint32_t largest = waiting_.front()->root.count;
    const auto add_rooms = [&](size_t begin, size_t room) {
        for (size_t i = 0; i < threads; ++i) {
            rooms_.push_back({begin + i * room, begin + (i + 1) * room - kMargin});
        }
    };
    if (const size_t room = (memory.capacity() - used) / threads;
        top.sorted_root() != nullptr && room >= subtree_room(largest) + kMargin) {
        add_rooms(used, room);
        return;
    }
    size_t place = used;
    size_t first_room = 0;
    size_t room = used / threads;
    if (used + count > memory.capacity() || room < largest + largest / 8 + kMargin) {
        room = subtree_room(largest);
        own_references_ = ReferenceBuffer(count + threads * room);
        references_ = own_references_.references();
        place = 0;
        first_room = count;
    }
    add_rooms(first_room, room);
    struct Copy {
        const Segment* from;
        size_t to;
    };
    std::vector<Copy> copies;
    for (Subtree& subtree : subtrees_) {
        subtree.is_gathered = true;
        subtree.begin = place;
        for (const Segment& segment : subtree.top->segments) {
            copies.push_back({&segment, place});
            place += segment.count;
        }
        place += kMargin;
    }
    parallel_for(threads_, copies.size(), [&](size_t i) {
        copy_references(copies[i].from->references, copies[i].from->count, references_.at(copies[i].to));
    });
}

void Subtrees::build() {
    unfinished_ = waiting_.size();
    parallel_for(threads_, static_cast<size_t>(threads_), [&](size_t, int worker) {
        try {
            while (Subtree* subtree = take()) {
                build_one(*subtree, worker);
                finish(*subtree);
            }
        } catch (...) {
            const std::lock_guard lock(mutex_);
            is_abandoned_ = true;
            changes_.fetch_add(1, std::memory_order_release);
            changes_.notify_all();
            throw;
        }
    });
}

/// The next subtree to build, waited for while there may be one; null when all are built.
Subtrees::Subtree* Subtrees::take() {
    bool is_idle = false;
    for (;;) {
        const uint32_t seen = changes_.load(std::memory_order_acquire);
        {
            const std::lock_guard lock(mutex_);
            const bool has_ended = unfinished_ == 0 || is_abandoned_;
            if (is_idle && (has_ended || !waiting_.empty())) {
                idle_.fetch_sub(1, std::memory_order_relaxed);
            }
            if (has_ended) {
                return nullptr;
            }
            if (!waiting_.empty()) {
                Subtree* next = waiting_.front();
                waiting_.pop_front();
                if (next->space == 0) {  // nothing is given while such a one waits, so that there is a room
                    next->room = rooms_.back();
                    next->space = next->room.begin;
                    rooms_.pop_back();
                    if (!next->is_gathered) {
                        next->begin = next->room.begin;
                        next->space += next->root.count;
                    }
                }
                return next;
            }
            if (!is_idle) {
                is_idle = true;
                idle_.fetch_add(1, std::memory_order_relaxed);
            }
        }
        wait_while_equal(changes_, seen);
    }
}

void Subtrees::finish(const Subtree& subtree) {
    const std::lock_guard lock(mutex_);
    rooms_.push_back(subtree.room);
    if (--unfinished_ == 0) {
        changes_.fetch_add(1, std::memory_order_release);
        changes_.notify_all();
    }
}

uint32_t Subtrees::give(const OpenNode& node, const References& references) {
    Room room{};
    {
        const std::lock_guard lock(mutex_);
        if (rooms_.empty() || rooms_.back().end - rooms_.back().begin < subtree_room(node.count)) {
            return kNotGiven;
        }
        room = rooms_.back();
        rooms_.pop_back();
    }
    copy_references(references, node.count, references_.at(room.begin));
    const std::lock_guard lock(mutex_);
    Subtree& subtree = subtrees_.emplace_back();
    subtree.root = node;
    subtree.is_gathered = true;
    subtree.begin = room.begin;
    subtree.space = room.begin + node.count;
    subtree.room = room;
    waiting_.push_back(&subtree);
    ++unfinished_;
    changes_.fetch_add(1, std::memory_order_release);
    changes_.notify_all();
    return static_cast<uint32_t>(subtrees_.size() - 1);
}

void Subtrees::build_one(Subtree& subtree, int worker) {
    SubtreeOutput& output = outputs_[static_cast<size_t>(worker)];
    if (output.nodes().data() == nullptr) {
        output = SubtreeOutput(soup_.size() / static_cast<uint32_t>(threads_), &memory_);
    }
    subtree.worker = worker;
    subtree.first_node = output.node_count();
    subtree.first_triangle = output.triangle_count();
    subtree.first_gap = output.gaps().size();
    if (!subtree.is_gathered) {
        gather(*subtree.top, references_.at(subtree.begin));
    }
    SubtreeSharing* sharing = threads_ > 1 ? this : nullptr;
    build_kernels().build_subtree(
        {&soup_, &parameters_, cancel_, sharing, sorted_, references_, subtree.begin, subtree.space, subtree.room.end},
        subtree.root, output);
    subtree.node_end = output.node_count();
    subtree.triangle_end = output.triangle_count();
    subtree.gap_end = output.gaps().size();
}

void Subtrees::compact(TopLevels* top, Tree& tree) {
    size_t nodes = 0;
    size_t triangles = 0;
    const bool is_whole = top == nullptr || sorted_ != nullptr;
    if (is_whole) {
        place(subtrees_[0], nodes, triangles);
    } else {
        of_top_.assign(top->nodes().size(), nullptr);
        top_places_.assign(top->nodes().size(), 0);
        top_boxes_.resize(top->nodes().size());
        for (Subtree& subtree : subtrees_) {
            if (subtree.top != nullptr) {
                of_top_[static_cast<size_t>(subtree.top - top->nodes().data())] = &subtree;
            }
        }
        place(*top, 0, nodes, triangles);
    }
    if (nodes > (1U << 30) || triangles / kBlockSize > kMaxBlocks) {
        throw std::length_error("the tree needs more nodes or blocks than its indices can count");
    }
    LargeBuffer<uint32_t> references = top != nullptr ? top->take_memory() : own_references_.take_memory();
    tree.blocks = memory_.keep<TriangleBlock>(std::move(references), triangles / kBlockSize);
    tree.nodes = LargeBuffer<KdNode>(nodes);
    if (is_whole) {
        tree.nodes.take_pages(0, nodes);
        std::copy_n(outputs_[0].nodes().begin(), nodes, tree.nodes.data());
        return;
    }
    parallel_for(threads_, subtrees_.size(), [&](size_t i) { copy(subtrees_[i], tree); });
    write_top(*top, 0, tree);
    for (const Subtree& subtree : subtrees_) {
        close_gaps(subtree, tree);
    }
    for (const Subtree& subtree : subtrees_) {
        for (const Gap& gap : gaps(subtree)) {
            extend_boxes(tree, 0, place_of(subtree, gap.inner));
        }
    }
}

std::span<const Gap> Subtrees::gaps(const Subtree& subtree) const {
    return std::span(outputs_[static_cast<size_t>(subtree.worker)].gaps())
        .subspan(subtree.first_gap, subtree.gap_end - subtree.first_gap);
}

/// Gives a subtree and those that fill its gaps their places, in depth-first order.
void Subtrees::place(Subtree& subtree, size_t& nodes, size_t& triangles) {
    subtree.place = nodes;
    subtree.triangle_place = triangles;
    size_t node = subtree.first_node;
    size_t triangle = subtree.first_triangle;
    const auto place_up_to = [&](size_t node_end, size_t triangle_end) {
        if (node != node_end) {
            const SubtreeOutput& output = outputs_[static_cast<size_t>(subtree.worker)];
            pieces_.push_back(output.piece(node, node_end, triangle, triangle_end, nodes, triangles / kBlockSize));
        }
        nodes += node_end - node;
        triangles += triangle_end - triangle;
        node = node_end;
        triangle = triangle_end;
    };
    for (const Gap& gap : gaps(subtree)) {
        place_up_to(gap.node, gap.triangle);
        place(subtrees_[gap.subtree], nodes, triangles);
    }
    place_up_to(subtree.node_end, subtree.triangle_end);
    subtree.place_end = nodes;
    subtree.triangle_place_end = triangles;
}

void Subtrees::place(const TopLevels& top, uint32_t index, size_t& nodes, size_t& triangles) {
    top_places_[index] = nodes;
    if (Subtree* subtree = of_top_[index]; subtree != nullptr) {
        place(*subtree, nodes, triangles);
        return;
    }
    pieces_.push_back(
        {static_cast<uint32_t>(nodes), static_cast<uint32_t>(triangles / kBlockSize), {&top_boxes_[index], 1}, {}, {}});
    ++nodes;
    place(top, top.nodes()[index].left, nodes, triangles);
    place(top, top.nodes()[index].right, nodes, triangles);
}

/// The final place of a node of the thread's output.
size_t Subtrees::place_of(const Subtree& subtree, size_t node) const {
    size_t place = subtree.place + (node - subtree.first_node);
    for (const Gap& gap : gaps(subtree)) {
        if (gap.node <= node) {
            place += subtrees_[gap.subtree].place_end - subtrees_[gap.subtree].place;
        }
    }
    return place;
}

void Subtrees::copy(const Subtree& subtree, Tree& tree) const {
    const SubtreeOutput& output = outputs_[static_cast<size_t>(subtree.worker)];
    size_t node = subtree.first_node;
    size_t triangle = subtree.first_triangle;
    size_t place = subtree.place;
    size_t triangle_place = subtree.triangle_place;
    const auto copy_up_to = [&](size_t node_end) {
        tree.nodes.take_pages(place, place + node_end - node);
        for (size_t i = node; i < node_end; ++i) {
            const KdNode from = output.nodes()[i];
            KdNode& to = tree.nodes[place + i - node];
            if (from.is_leaf()) {
                const size_t block = from.first_block() - triangle / kBlockSize + triangle_place / kBlockSize;
                to = KdNode::leaf(static_cast<uint32_t>(block), from.references());
            } else {
                const size_t right = from.right_child();
                const size_t right_place = right < node_end ? place + right - node : place_of(subtree, right);
                to = KdNode::inner(from.axis(), from.split(), static_cast<uint32_t>(right_place));
            }
        }
    };
    for (const Gap& gap : gaps(subtree)) {
        copy_up_to(gap.node);
        place = subtrees_[gap.subtree].place_end;
        triangle_place = subtrees_[gap.subtree].triangle_place_end;
        node = gap.node;
        triangle = gap.triangle;
    }
    copy_up_to(subtree.node_end);
}

void Subtrees::write_top(const TopLevels& top, uint32_t index, Tree& tree) {
    const TopNode& node = top.nodes()[index];
    if (!node.is_split()) {
        return;
    }
    write_top(top, node.left, tree);
    write_top(top, node.right, tree);
    const size_t right = top_places_[node.right];
    tree.nodes[top_places_[index]] = KdNode::inner(node.split.axis, node.split.position, static_cast<uint32_t>(right));
    top_boxes_[index] = box(top_places_[node.left]);
    top_boxes_[index].extend(box(right));
}

Box3f& Subtrees::box(size_t place) {
    const auto node = static_cast<uint32_t>(place);
    return piece_of(pieces_, node).box(node);
}

/// Links the subtrees that fill gaps.
void Subtrees::close_gaps(const Subtree& subtree, Tree& tree) {
    for (const Gap& gap : gaps(subtree)) {
        const size_t parent = place_of(subtree, gap.inner);
        const KdNode node = tree.nodes[parent];
        tree.nodes[parent] =
            KdNode::inner(node.axis(), node.split(), static_cast<uint32_t>(subtrees_[gap.subtree].place));
    }
}

/// Boxes from a node on the way to `last` down to it, which come out right from the last up.
void Subtrees::extend_boxes(const Tree& tree, size_t index, size_t last) {
    const size_t right = tree.nodes[index].right_child();
    if (index != last) {
        extend_boxes(tree, last < right ? index + 1 : right, last);
    }
    Box3f both = box(index + 1);
    both.extend(box(right));
    box(index) = both;
}

}  // namespace espalier
