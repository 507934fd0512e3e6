// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "kdtree/traversal.h"
#include "render/light.h"
#include "render/sampling.h"
#include "render/scene.h"

namespace espalier {

/// Surface points to be lit, as vectors want them: eight together, component by component. Frame: as of SurfacePoint.
struct LitPoints {
    static constexpr size_t kGroup = 8;

    struct alignas(64) Group {
        double position[3][kGroup];
        double normal[3][kGroup];  // for shading, of unit length
        double start_size[kGroup];
        float start[3][kGroup];  // of shadow rays
        float base_color[3][kGroup];
        uint32_t pixel[kGroup];  // in the picture; picks the sample together with the next two
        uint32_t sequence_x[kGroup], sequence_y[kGroup];
        uint32_t target[kGroup];  // where its light goes
    };

    std::vector<Group> groups;  // the last one may have lanes without a point
    size_t size = 0;

    void clear();
    /// sequence: the point of the sequence that the sample has, see sampling.h.
    void add(const SurfacePoint& surface, uint32_t pixel, SequencePoint sequence, uint32_t target);
};

/// What light a point reflects if a shadow ray is not blocked.
struct Arrival {
    uint32_t target;
    Vec3d radiance;
};

/// One sample of a light for each point. For those that may bring light: the ray from the point, which starts strictly
/// on the side to which the geometric normal points, as near to the surface as float coordinates allow, so that it
/// never meets the face it starts on; and the light. `rays` and `arrivals` have room for one a point; returns how many
/// there are. The same numbers on every instruction set. `dimension` sets the samples of one light apart from those of
/// others.
size_t light_rays(const Light& light, const LitPoints& points, uint32_t dimension, std::span<Ray> rays,
                  std::span<Arrival> arrivals);

}  // namespace espalier
