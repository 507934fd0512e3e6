// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/film.h"

#include <algorithm>
#include <cstdint>

namespace espalier {

Film::Film(int width, int height)
    : width_(width), height_(height), pixels_(4 * static_cast<size_t>(width) * static_cast<size_t>(height)) {
    for (int y = 0; y < height; y += kTileSize) {
        for (int x = 0; x < width; x += kTileSize) {
            tiles_.push_back({x, y, std::min(kTileSize, width - x), std::min(kTileSize, height - y)});
        }
    }
    const auto off_centre = [&](const Tile& tile) {
        const int64_t dx = 2 * tile.x + tile.width - width_, dy = 2 * tile.y + tile.height - height_;
        return dx * dx + dy * dy;
    };
    std::stable_sort(tiles_.begin(), tiles_.end(),
                     [&](const Tile& a, const Tile& b) { return off_centre(a) < off_centre(b); });
    finished_ = std::vector<std::atomic<bool>>(tiles_.size());
}

void Film::finish(size_t tile) {
    finished_[tile].store(true, std::memory_order_release);
    finished_count_.fetch_add(1, std::memory_order_relaxed);
}

double Film::progress() const {
    return static_cast<double>(finished_count_.load(std::memory_order_relaxed)) / static_cast<double>(tiles_.size());
}

void Film::copy_finished(std::span<float> out) const {
    std::fill(out.begin(), out.end(), 0.0F);
    for (size_t i = 0; i < tiles_.size(); ++i) {
        if (!finished_[i].load(std::memory_order_acquire))
            continue;
        const Tile& tile = tiles_[i];
        for (int y = tile.y; y < tile.y + tile.height; ++y) {
            const size_t row = 4 * (static_cast<size_t>(y) * static_cast<size_t>(width_) + static_cast<size_t>(tile.x));
            std::copy_n(&pixels_[row], 4 * static_cast<size_t>(tile.width), &out[row]);
        }
    }
}

}  // namespace espalier
