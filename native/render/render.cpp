// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/render.h"

#include <algorithm>
#include <chrono>
#include <vector>

#include "geometry/float_environment.h"
#include "kdtree/parallel.h"
#include "kdtree/traversal.h"
#include "render/light_rays.h"
#include "render/sampling.h"
#include "render/shading.h"

namespace espalier {
namespace {

/// Samples of a tile that are traced together: with 256 pixels enough rays to fill packets and streams, and few enough
/// that a cancel, looked for between batches, is noticed at once.
constexpr int kSamplesPerBatch = 4;
constexpr int kBlock = 4;  // pixels are visited in squares of this side, so that neighbouring rays share a packet

struct PixelSum {
    int x, y;
    Vec3d radiance{0.0, 0.0, 0.0};
};

/// A surface point to be lit, and where its light goes.
struct Shade {
    SurfacePoint surface;
    uint32_t pixel;   // in the tile
    uint32_t sample;  // of the pixel
};

std::vector<PixelSum> pixels_in_blocks(const Film::Tile& tile) {
    std::vector<PixelSum> pixels;
    pixels.reserve(static_cast<size_t>(tile.width) * static_cast<size_t>(tile.height));
    for (int y0 = 0; y0 < tile.height; y0 += kBlock) {
        for (int x0 = 0; x0 < tile.width; x0 += kBlock) {
            for (int y = y0; y < std::min(y0 + kBlock, tile.height); ++y) {
                for (int x = x0; x < std::min(x0 + kBlock, tile.width); ++x)
                    pixels.push_back({tile.x + x, tile.y + y});
            }
        }
    }
    return pixels;
}

/// Draws one tile; one object per tile, so nothing is shared between threads.
class TileTracer {
 public:
    TileTracer(const Scene& scene, const Tree& tree, const Camera& camera, std::span<const Light> lights,
               const RenderSettings& settings, const std::atomic<bool>& cancel)
        : scene_(scene), tree_(tree), camera_(camera), lights_(lights), settings_(settings), cancel_(cancel) {}

    /// Returns the number of shadow rays.
    uint64_t draw(Film& film, const Film::Tile& tile) {
        pixels_ = pixels_in_blocks(tile);
        for (int first = 0; first < settings_.samples; first += kSamplesPerBatch) {
            trace_primary(film, first, std::min(first + kSamplesPerBatch, settings_.samples));
            for (size_t light = 0; light < lights_.size(); ++light)
                trace_light(light);
        }
        for (const PixelSum& pixel : pixels_) {
            const Vec3f color = to_float(pixel.radiance / settings_.samples);
            float* out = film.pixel(pixel.x, pixel.y);
            out[0] = color.x, out[1] = color.y, out[2] = color.z, out[3] = 1.0F;
        }
        return shadow_rays_;
    }

 private:
    void stop_if_cancelled() const {
        if (cancel_.load(std::memory_order_relaxed))
            throw RenderCancelled();
    }

    /// Dimension 0 of a pixel's samples moves the primary ray within it, dimension 1 + i samples light i.
    static uint32_t index_of(const Film& film, const PixelSum& pixel) {
        return static_cast<uint32_t>(pixel.y) * static_cast<uint32_t>(film.width()) + static_cast<uint32_t>(pixel.x);
    }

    void trace_primary(const Film& film, int first_sample, int end_sample) {
        stop_if_cancelled();
        rays_.clear();
        for (int sample = first_sample; sample < end_sample; ++sample) {
            const SequencePoint sequence = sequence_point(static_cast<uint32_t>(sample));
            for (const PixelSum& pixel : pixels_) {
                const Sample2 offset = settings_.samples == 1
                                           ? Sample2{0.5, 0.5}
                                           : scrambled(sequence, hash_bits(index_of(film, pixel) ^ dimension_key(0)));
                rays_.push_back(camera_.ray((pixel.x + offset.x) / film.width(), (pixel.y + offset.y) / film.height()));
            }
        }
        hits_.resize(rays_.size());
        intersect(tree_, rays_, hits_);

        shades_.clear();
        for (size_t i = 0; i < rays_.size(); ++i) {
            const auto pixel = static_cast<uint32_t>(i % pixels_.size());
            const Hit& hit = hits_[i];
            if (hit.triangle < 0) {
                pixels_[pixel].radiance += settings_.world_color;
                continue;
            }
            shades_.push_back(
                {scene_.surface(static_cast<uint32_t>(hit.triangle), hit.u, hit.v, to_double(rays_[i].direction)),
                 pixel, static_cast<uint32_t>(first_sample) + static_cast<uint32_t>(i / pixels_.size())});
        }
        drop_blocked_lifts();
        points_.clear();
        for (const Shade& shade : shades_)
            points_.add(shade.surface, index_of(film, pixels_[shade.pixel]), sequence_point(shade.sample), shade.pixel);
    }

    void drop_blocked_lifts() {
        rays_.clear();
        std::vector<SurfacePoint*> lifted;
        for (Shade& shade : shades_) {
            if (const std::optional<Ray> ray = lift_ray(shade.surface)) {
                rays_.push_back(*ray);
                lifted.push_back(&shade.surface);
            }
        }
        blocked_.resize(rays_.size());
        occluded(tree_, rays_, blocked_);
        for (size_t i = 0; i < lifted.size(); ++i) {
            if (blocked_[i] != 0)
                lifted[i]->shadow_lift = {0.0, 0.0, 0.0};
        }
    }

    void trace_light(size_t index) {
        stop_if_cancelled();
        const Light& light = lights_[index];
        rays_.resize(points_.size);
        arrivals_.resize(points_.size);
        const size_t count = light_rays(light, points_, 1 + static_cast<uint32_t>(index), rays_, arrivals_);
        blocked_.assign(count, 0);
        if (light.shadow) {
            shadow_rays_ += count;
            occluded(tree_, std::span(rays_).first(count), blocked_);
        }
        for (size_t i = 0; i < count; ++i) {
            if (blocked_[i] == 0)
                pixels_[arrivals_[i].target].radiance += arrivals_[i].radiance;
        }
    }

    const Scene& scene_;
    const Tree& tree_;
    const Camera& camera_;
    std::span<const Light> lights_;
    const RenderSettings& settings_;
    const std::atomic<bool>& cancel_;
    std::vector<PixelSum> pixels_;
    std::vector<Ray> rays_;
    std::vector<Hit> hits_;
    std::vector<Shade> shades_;
    LitPoints points_;
    std::vector<Arrival> arrivals_;
    std::vector<uint8_t> blocked_;
    uint64_t shadow_rays_ = 0;
};

/// The lights to draw with: the scene's own and its world, or a soft sky in a scene that has none.
std::vector<Light> with_sky(std::span<const Light> lights, Vec3d world_color) {
    std::vector<Light> all(lights.begin(), lights.end());
    if (lights.empty()) {
        all.push_back(Light::sky({1.0, 1.0, 1.0}, {0.3, 0.3, 0.3}));
    } else if (world_color.x > 0.0 || world_color.y > 0.0 || world_color.z > 0.0) {
        all.push_back(Light::sky(world_color, world_color));
    }
    return all;
}

/// In which order tiles are drawn: as they lie, or such that one after the other is far from it, so that threads which
/// open subtrees do not wait for one another.
std::vector<size_t> tile_order(size_t count, bool far_apart) {
    const size_t step = far_apart ? 16 : 1;
    std::vector<size_t> order;
    order.reserve(count);
    for (size_t first = 0; first < step; ++first) {
        for (size_t tile = first; tile < count; tile += step)
            order.push_back(tile);
    }
    return order;
}

}  // namespace

TraceReport render_picture(const Scene& scene, const Tree& tree, const Camera& camera, std::span<const Light> lights,
                           const RenderSettings& settings, Film& film, const std::atomic<bool>& cancel) {
    const FloatEnvironment environment;
    const auto start = std::chrono::steady_clock::now();
    TraceReport report;
    report.threads = settings.threads > 0 ? settings.threads : hardware_threads();
    report.samples = settings.samples;
    const std::vector<Light> all_lights = with_sky(lights, settings.world_color);

    std::atomic<uint64_t> shadow_rays{0};
    const std::vector<size_t> order = tile_order(film.tiles().size(), tree.on_demand != nullptr);
    parallel_for(report.threads, order.size(), [&](size_t i) {
        TileTracer tracer(scene, tree, camera, all_lights, settings, cancel);
        shadow_rays.fetch_add(tracer.draw(film, film.tiles()[order[i]]), std::memory_order_relaxed);
        film.finish(order[i]);
    });

    report.primary_rays = static_cast<uint64_t>(film.width()) * static_cast<uint64_t>(film.height()) *
                          static_cast<uint64_t>(settings.samples);
    report.shadow_rays = shadow_rays.load();
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    report.trace_ms = seconds * 1e3;
    report.mrays_per_s = static_cast<double>(report.primary_rays + report.shadow_rays) / seconds * 1e-6;
    return report;
}

}  // namespace espalier
