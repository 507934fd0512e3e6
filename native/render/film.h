// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <atomic>
#include <cstddef>
#include <span>
#include <vector>

namespace espalier {

/// A picture that grows tile by tile: linear RGBA float, bottom row first. One thread writes a tile and then finishes
/// it; any thread may look at what is finished meanwhile.
class Film {
 public:
    static constexpr int kTileSize = 16;

    struct Tile {
        int x, y, width, height;
    };

    Film(int width, int height);

    int width() const { return width_; }
    int height() const { return height_; }

    /// From the middle of the picture outwards.
    const std::vector<Tile>& tiles() const { return tiles_; }

    float* pixel(int x, int y) {
        return &pixels_[4 * (static_cast<size_t>(y) * static_cast<size_t>(width_) + static_cast<size_t>(x))];
    }
    void finish(size_t tile);

    /// The share of the tiles that are finished.
    double progress() const;

    /// Copies the finished tiles to `out` (width * height * 4 floats); the rest is transparent black.
    void copy_finished(std::span<float> out) const;

 private:
    int width_, height_;
    std::vector<float> pixels_;
    std::vector<Tile> tiles_;
    std::vector<std::atomic<bool>> finished_;
    std::atomic<size_t> finished_count_{0};
};

}  // namespace espalier
