// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/plain_traversal.h"

#include <algorithm>

#include "geometry/float_environment.h"
#include "kdtree/simd_config.h"
#include "kdtree/simd_target.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kdtree/plain_traversal.cpp"
#include <hwy/foreach_target.h>
// Highway's own header has to follow foreach_target.h.
#include <hwy/highway.h>

#include "kdtree/trace-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {

void plain_intersect(const Tree& tree, std::span<const Ray> rays, std::span<Hit> hits) {
    intersect_all<false>(tree, rays, hits);
}

void plain_occluded(const Tree& tree, std::span<const Ray> rays, std::span<uint8_t> results) {
    occluded_all<false>(tree, rays, results);
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace espalier {
namespace {

struct TraceKernels {
    void (*intersect)(const Tree&, std::span<const Ray>, std::span<Hit>);
    void (*occluded)(const Tree&, std::span<const Ray>, std::span<uint8_t>);
};

const TraceKernels& kernels() {
    static const TraceKernels chosen{ESPALIER_OF_TARGET(plain_intersect), ESPALIER_OF_TARGET(plain_occluded)};
    return chosen;
}

}  // namespace

void plain_intersect(const Tree& tree, std::span<const Ray> rays, std::span<Hit> hits) {
    const FloatEnvironment environment;
    if (tree.wide_nodes.size() == 0) {
        std::transform(rays.begin(), rays.end(), hits.begin(), [](const Ray& ray) { return Hit{ray.t_max, 0, 0, -1}; });
        return;
    }
    kernels().intersect(tree, rays, hits);
}

void plain_occluded(const Tree& tree, std::span<const Ray> rays, std::span<uint8_t> results) {
    const FloatEnvironment environment;
    if (tree.wide_nodes.size() == 0) {
        std::fill_n(results.begin(), rays.size(), uint8_t{0});
        return;
    }
    kernels().occluded(tree, rays, results);
}

}  // namespace espalier
#endif
