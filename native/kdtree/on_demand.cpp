// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/on_demand.h"

#include <algorithm>
#include <array>
#include <stdexcept>
#include <utility>

#include "kdtree/layout.h"
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
      memory_(size_t{2} * soup.size() + kWhole, 0, SIZE_MAX),
      most_parts_(most_parts(soup.size())),
      parts_(new Part[most_parts_]),
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
            if (parts_[number].node.count > cut) {
                open(WideNode::unopened(number));
            }
        });
        first += count;
    }
    opened_before_ = opened_.load();
}

/// The wide node for a top node and those below it.
uint32_t OnDemand::lay_out(uint32_t top_node) {
    const auto at = [&](uint32_t i) -> const TopNode& { return top_.nodes()[i]; };
    std::array<uint32_t, WideNode::kWidth> items{top_node};
    ChildOrder order;
    int count = 1;
    while (count < WideNode::kWidth) {
        int widest = -1;
        for (int i = 0; i < count; ++i) {
            const TopNode& item = at(items[static_cast<size_t>(i)]);
            if (item.is_split() && (widest < 0 || half_area(item.node.tight) >
                                                      half_area(at(items[static_cast<size_t>(widest)]).node.tight))) {
                widest = i;
            }
        }
        if (widest < 0) {
            break;
        }
        uint32_t& opened = items[static_cast<size_t>(widest)];
        const TopNode& parent = at(opened);
        if (at(parent.left).node.count == 0 || at(parent.right).node.count == 0) {  // nothing takes no place
            opened = at(parent.left).node.count == 0 ? parent.right : parent.left;
            continue;
        }
        order.split(parent.split.axis, widest, count);
        opened = parent.left;
        items[static_cast<size_t>(count++)] = parent.right;
    }
    const uint32_t index = add_nodes(1);
    std::array<Box3f, WideNode::kWidth> boxes;
    for (int i = 0; i < count; ++i) {
        boxes[static_cast<size_t>(i)] = at(items[static_cast<size_t>(i)]).node.tight;
    }
    order.write(std::span(boxes).first(static_cast<size_t>(count)), nodes_[index]);
    for (int i = 0; i < count; ++i) {
        const TopNode& item = at(items[static_cast<size_t>(i)]);
        if (item.node.count > 0) {
            nodes_[index].child[i] =
                item.is_split() ? lay_out(items[static_cast<size_t>(i)]) : new_part(item.node, &item, {});
        }
    }
    return index;
}

uint32_t OnDemand::new_part(const OpenNode& node, const TopNode* top, const References& references) {
    const uint32_t number = part_count_.fetch_add(1, std::memory_order_relaxed);
    if (number >= most_parts_) {
        throw std::length_error("the tree has more subtrees to open than it can count");
    }
    Part& part = parts_[number];
    part.node = node;
    part.top = top;
    part.references = references;
    return WideNode::unopened(number);
}

uint32_t OnDemand::open(uint32_t child) {
    Part& part = parts_[WideNode::number(child)];
    uint32_t code = part.code.load(std::memory_order_acquire);
    if (code == 0) {
        const std::lock_guard lock(part.mutex);
        code = part.code.load(std::memory_order_relaxed);
        if (code == 0) {
            code = build(part);
            part.code.store(code, std::memory_order_release);
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
        part.node.count > whole_ && has_places ? divide(part.node, *scratch) : build_whole(part.node, *scratch);
    const std::lock_guard lock(scratch_mutex_);
    scratch_.push_back(std::move(scratch));
    return code;
}

std::unique_ptr<OnDemand::Scratch> OnDemand::take_scratch() {
    const std::lock_guard lock(scratch_mutex_);
    if (scratch_.empty()) {
        return std::make_unique<Scratch>();
    }
    std::unique_ptr<Scratch> taken = std::move(scratch_.back());
    scratch_.pop_back();
    return taken;
}

/// Splits a node into the children of one wide node, which wait to be opened. Left children stay where their parent's
/// references lie in the scratch room, right ones go behind all others.
uint32_t OnDemand::divide(const OpenNode& node, Scratch& scratch) {
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
            order.split(split.axis, static_cast<int>(widest - items.data()), static_cast<int>(count));
            items[count++] = right;
        }
    }
    if (count == 1 && items[0].node.count > 0) {
        copy_references(at(items[0].begin), items[0].node.count, at(0));
        return build_whole(items[0].node, scratch);
    }

    size_t references = 0;
    for (const Item& item : std::span(items).first(count)) {
        references += item.node.count;
    }
    const References memory = memory_.take(static_cast<uint32_t>(references + ReferenceBuffer::kSlack));
    const uint32_t index = add_nodes(1);
    std::array<Box3f, WideNode::kWidth> boxes;
    std::transform(items.begin(), items.begin() + static_cast<std::ptrdiff_t>(count), boxes.begin(),
                   [](const Item& item) { return item.node.tight; });
    order.write(std::span(boxes).first(count), nodes_[index]);
    size_t begin = 0;
    for (size_t i = 0; i < count; ++i) {
        const References place = memory.at(begin);
        copy_references(at(items[i].begin), items[i].node.count, place);
        begin += items[i].node.count;
        nodes_[index].child[i] = new_part(items[i].node, nullptr, place);
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
    collapse_whole(output.nodes(), output.whole(), scratch.wide);
    return append(scratch.wide, output.triangles());
}

/// Moves wide nodes and blocks to where rays find them; returns the index of the first.
uint32_t OnDemand::append(WideNodes& wide, std::span<const uint32_t> triangles) {
    const size_t blocks = triangles.size() / kBlockSize;
    const size_t first_block = block_count_.fetch_add(blocks, std::memory_order_relaxed);
    if (first_block + blocks > most_blocks_) {
        throw std::length_error("the tree needs more triangle blocks than it has room for");
    }
    kernels_.write_blocks(soup_, classes_, triangles.data(), blocks, blocks_ + first_block);
    const uint32_t first = add_nodes(wide.count());
    for (uint32_t i = 0; i < wide.count(); ++i) {
        WideNode& node = nodes_[first + i];
        node = wide[i];
        for (uint32_t& child : node.child) {
            const bool is_leaf = (child & WideNode::kLeafFlag) != 0;
            child = is_leaf ? WideNode::leaf(WideNode::first_block(child) + static_cast<uint32_t>(first_block),
                                             WideNode::blocks(child))
                            : child + first;
        }
    }
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
