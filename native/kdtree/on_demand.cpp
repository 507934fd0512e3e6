// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/on_demand.h"

#include <algorithm>
#include <array>
#include <stdexcept>
#include <utility>

#include "kdtree/child_order.h"
#include "kdtree/parallel.h"

namespace espalier {
namespace {

/// References of a subtree that is built in one go: a fraction of a millisecond's work.
constexpr uint32_t kWhole = 1024;
/// Before rays start, nodes of more than this share of all references are split.
constexpr uint32_t kTopNodes = 16;

uint32_t most_parts(uint32_t triangles) { return std::min(triangles / 64 + 4096, kMaxUnopened); }

/// Each reference may end in a block of its own.
size_t most_blocks(uint32_t triangles) { return std::min<size_t>(triangles + spare_references(triangles), kMaxBlocks); }

}  // namespace

OnDemand::OnDemand(const TriangleSoup& soup, const BuildParameters& parameters, const std::atomic<bool>* cancel,
                   int threads)
    : soup_(soup),
      parameters_(parameters),
      kernels_(build_kernels()),
      top_(soup_, parameters_, cancel, threads),
      threads_(threads),
      whole_(std::max(kWhole, parameters.one_thread)),
      memory_(ReferenceBuffer(size_t{2} * soup.size() + kWhole)),
      most_parts_(most_parts(soup.size())),
      parts_(most_parts_ / PartChunk::kSize + 1),
      most_blocks_(most_blocks(soup.size())) {}

void OnDemand::make_references(Tree& tree) {
    top_.make_references();
    tree.report.rejected_faces = top_.rejected();
    tree.bounds = top_.nodes()[0].node.cell;
    classes_ = SizeClasses(tree.bounds);
}

void OnDemand::split_top(Tree& tree) {
    if (top_.nodes()[0].node.count == 0) {
        return;
    }
    // From then on one node for each thread will do; a large scene has them already.
    top_.split_above(soup_.size() / static_cast<uint32_t>(threads_));
    // Only what is written takes memory. Inner nodes have two children at least, so there are no more of them.
    const size_t usual = usual_block_bytes(soup_.size());
    tree.wide_nodes = LargeBuffer<WideNode>(most_blocks_, usual / 8);
    tree.blocks = LargeBuffer<TriangleBlock>(most_blocks_, usual);
    nodes_ = tree.wide_nodes.data();
    blocks_ = tree.blocks.data();
    lay_out(0);
    const uint32_t cut = std::max(soup_.size() / kTopNodes, whole_);
    for (uint32_t first = 0; first < part_count_.load();) {
        const uint32_t count = part_count_.load() - first;
        parallel_for(threads_, count, [&](size_t i) {
            const auto number = first + static_cast<uint32_t>(i);
            if (part(number).node.count > cut) {
                open(WideNode::unopened(number));
            }
        });
        first += count;
    }
    opened_before_ = opened_.load();
    scratch_.clear();  // larger than any subtree that rays open will need
    scratch_count_ = 0;
}

/// The wide node for a top node and those below it.
uint32_t OnDemand::lay_out(uint32_t top_node) {
    const auto at = [&](uint32_t i) -> const TopNode& { return top_.nodes()[i]; };
    std::array<uint32_t, WideNode::kWidth> items{top_node};
    ChildOrder order;
    size_t count = 1;
    while (count < items.size()) {
        size_t widest = count;
        for (size_t i = 0; i < count; ++i) {
            const TopNode& item = at(items[i]);
            if (item.is_split() &&
                (widest == count || half_area(item.node.tight) > half_area(at(items[widest]).node.tight))) {
                widest = i;
            }
        }
        if (widest == count) {
            break;
        }
        uint32_t& opened = items[widest];
        const TopNode& parent = at(opened);
        if (at(parent.left).node.count == 0 || at(parent.right).node.count == 0) {  // nothing takes no place
            opened = at(parent.left).node.count == 0 ? parent.right : parent.left;
            continue;
        }
        order.split(parent.split.axis, widest, count);
        opened = parent.left;
        items[count++] = parent.right;
    }
    const uint32_t index = add_nodes(1);
    WideNode& wide = nodes_[index];
    order.write(count, wide);
    for (size_t i = 0; i < count; ++i) {
        const TopNode& item = at(items[i]);
        set_box(wide, i, item.node.tight);
        if (item.node.count > 0) {
            wide.child[i] = item.is_split() ? lay_out(items[i]) : new_part(item.node, &item, {});
        } else {
            wide.child[i] = WideNode::leaf(0, 1);
        }
    }
    return index;
}

uint32_t OnDemand::new_part(const OpenNode& node, const TopNode* top, const References& references) {
    const uint32_t number = part_count_.fetch_add(1, std::memory_order_relaxed);
    if (number >= most_parts_) {
        throw std::length_error("the tree has more subtrees to open than it can count");
    }
    PartChunk& chunk = parts_[number / PartChunk::kSize];
    std::call_once(chunk.is_made, [&] { chunk.parts = std::make_unique<Part[]>(PartChunk::kSize); });
    Part& made = part(number);
    made.node = node;
    made.top = top;
    made.references = references;
    return WideNode::unopened(number);
}

uint32_t OnDemand::open(uint32_t child) {
    Part& wanted = part(WideNode::number(child));
    uint32_t code = wanted.code.load(std::memory_order_acquire);
    if (code == 0) {
        const std::lock_guard lock(wanted.mutex);
        code = wanted.code.load(std::memory_order_relaxed);
        if (code == 0) {
            code = build(wanted);
            wanted.code.store(code, std::memory_order_release);
            opened_.fetch_add(1, std::memory_order_relaxed);
        }
    }
    return code;
}

uint32_t OnDemand::build(Part& part) {
    std::unique_ptr<Scratch> scratch = take_scratch();
    const size_t room = subtree_room(std::max(part.node.count, kWhole));
    if (scratch->room.references().triangle == nullptr || scratch->room.capacity() < room) {
        scratch->room = ReferenceBuffer(room);
    }
    if (part.top != nullptr) {
        gather(*part.top, scratch->room.references());
    } else {
        copy_references(part.references, part.node.count, scratch->room.references());
    }
    const bool has_places = part_count_.load(std::memory_order_relaxed) + 256 * WideNode::kWidth < most_parts_;
    const uint32_t code =
        part.node.count > whole_ && has_places ? divide(part, *scratch) : build_whole(part.node, *scratch);
    const std::lock_guard lock(scratch_mutex_);
    scratch_.push_back(std::move(scratch));
    return code;
}

std::unique_ptr<OnDemand::Scratch> OnDemand::take_scratch() {
    const std::lock_guard lock(scratch_mutex_);
    if (scratch_.empty()) {
        scratch_.reserve(++scratch_count_);  // giving it back must not fail
        return std::make_unique<Scratch>();
    }
    std::unique_ptr<Scratch> taken = std::move(scratch_.back());
    scratch_.pop_back();
    return taken;
}

/// Splits a node into the children of one wide node, which wait to be opened. In the scratch room, left children stay
/// where their parent's references lie, and right ones go behind all others.
uint32_t OnDemand::divide(const Part& part, Scratch& scratch) {
    const OpenNode& node = part.node;
    struct Item {
        OpenNode node;
        size_t begin;
        bool is_final;  ///< no plane pays
    };
    std::array<Item, WideNode::kWidth> items;
    ChildOrder order;
    size_t count = 1;
    size_t end = node.count;
    items[0] = {node, 0, false};
    const auto at = [&](size_t begin) { return scratch.room.references().at(begin); };
    while (count < items.size()) {
        Item* widest = nullptr;
        for (Item& item : std::span(items).first(count)) {
            if (!item.is_final && item.node.count > whole_ && end + item.node.count <= scratch.room.capacity() &&
                (widest == nullptr || half_area(item.node.tight) > half_area(widest->node.tight))) {
                widest = &item;
            }
        }
        if (widest == nullptr) {
            break;
        }
        const OpenNode parent = widest->node;
        const Split split = kernels_.find_split(parent, at(widest->begin), parameters_);
        if (split.axis < 0) {
            widest->is_final = true;
            continue;
        }
        Partition parts;
        Item right{{}, widest->begin, false};
        if (!cuts_empty_space(parent, split, parts)) {
            right.begin = end;
            parts = kernels_.partition(soup_, at(widest->begin), parent.count, split, parameters_.clip,
                                       at(widest->begin), at(end));
            end += parts.right_count;
        }
        open_children(parent, split, parts, widest->node, right.node);
        if (widest->node.count == 0) {
            *widest = right;  // nothing takes no place
        } else if (right.node.count != 0) {
            order.split(split.axis, static_cast<size_t>(widest - items.data()), count);
            items[count++] = right;
        }
    }
    if (count == 1 && items[0].node.count > 0) {
        copy_references(at(items[0].begin), items[0].node.count, at(0));
        return build_whole(items[0].node, scratch);
    }

    const uint32_t index = add_nodes(1);
    WideNode& wide = nodes_[index];
    order.write(count, wide);
    // Children lie where their parent lay as far as there is room, whose pages are taken already. Nothing there is
    // touched before all that may fail is done: who asks again finds the parent as it was.
    const uint32_t room = part.top == nullptr ? node.count : 0;
    uint32_t used = 0;
    std::array<References, WideNode::kWidth> places;
    for (size_t i = 0; i < count; ++i) {
        const uint32_t references = items[i].node.count;
        if (used + references <= room) {
            places[i] = part.references.at(used);
            used += references;
        } else {
            places[i] = memory_.take(references);
        }
        set_box(wide, i, items[i].node.tight);
        wide.child[i] = new_part(items[i].node, nullptr, places[i]);
    }
    for (size_t i = 0; i < count; ++i) {
        copy_references(at(items[i].begin), items[i].node.count, places[i]);
    }
    return index;
}

/// Builds a subtree whose references lie at the beginning of the scratch room.
uint32_t OnDemand::build_whole(const OpenNode& node, Scratch& scratch) {
    SubtreeOutput& output = scratch.output;
    output.rewind(0, 0);
    const ReferenceBuffer& room = scratch.room;
    kernels_.build_subtree(
        {&soup_, &parameters_, nullptr, nullptr, nullptr, room.references(), 0, node.count, room.capacity()}, node,
        output);
    const size_t blocks = output.triangles().size() / kBlockSize;
    const size_t first_block = block_count_.fetch_add(blocks, std::memory_order_relaxed);
    if (first_block + blocks > most_blocks_) {
        throw std::length_error("the tree needs more triangle blocks than it has room for");
    }
    kernels_.write_blocks(soup_, classes_, output.triangles().data(), blocks, blocks_ + first_block);

    KdRun whole{0, static_cast<uint32_t>(output.node_count()), {}};
    scratch.plans.resize(std::max(scratch.plans.size(), output.node_count()));
    const TreePiece piece = output.whole();
    const Collapse collapse(output.nodes(), {&piece, 1}, scratch.plans);
    collapse.plan(whole);
    const uint32_t first = add_nodes(collapse.wide_nodes(0));
    collapse.write({0, first}, static_cast<uint32_t>(first_block), nodes_);
    return first;
}

uint32_t OnDemand::add_nodes(uint32_t count) {
    const size_t first = node_count_.fetch_add(count, std::memory_order_relaxed);
    if (first + count > most_blocks_) {
        throw std::length_error("the tree needs more nodes than it has room for");
    }
    return static_cast<uint32_t>(first);
}

}  // namespace espalier
