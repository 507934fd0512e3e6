// SPDX-License-Identifier: GPL-3.0-or-later
// Embree 3 as the peer: devices and scenes that release themselves.
#pragma once

#include <embree3/rtcore.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "bench.h"
#include "kdtree/simd_target.h"

namespace espalier::bench {

using Device = std::shared_ptr<std::remove_pointer_t<RTCDevice>>;
using EmbreeScene = std::shared_ptr<std::remove_pointer_t<RTCScene>>;

/// A device with the instruction set that our side uses. Embree has one thread pool, as large as the largest device
/// asks for: keep one device at a time.
inline Device new_device(int threads) {
    const std::string simd = simd_target_names().front();
    std::string config = "threads=" + std::to_string(threads);
    if (simd != "neon") {
        config += ",isa=" + (simd == "sse4" ? "sse4.2" : simd);
    }
    const RTCDevice device = rtcNewDevice(config.c_str());
    if (device == nullptr) {
        throw std::runtime_error("Embree makes no device of \"" + config + "\"");
    }
    return {device, rtcReleaseDevice};
}

struct EmbreeBuilder {
    const char* name;
    RTCBuildQuality quality;
    RTCSceneFlags flags;
};
/// The ones that ray tracing would use: ROBUST, except where that turns spatial splits off.
inline constexpr std::array kEmbreeBuilders{
    EmbreeBuilder{"Embree LOW", RTC_BUILD_QUALITY_LOW, RTC_SCENE_FLAG_ROBUST},
    EmbreeBuilder{"Embree MEDIUM", RTC_BUILD_QUALITY_MEDIUM, RTC_SCENE_FLAG_ROBUST},
    EmbreeBuilder{"Embree HIGH", RTC_BUILD_QUALITY_HIGH, RTC_SCENE_FLAG_NONE},
};
inline constexpr const EmbreeBuilder& kMedium = kEmbreeBuilders[1];

/// From triangles in memory to a scene that can be traced. Embree reads vertices and indices where they lie.
inline EmbreeScene build_embree(const Device& device, const TriangleSoup& soup, const EmbreeBuilder& builder) {
    const RTCGeometry geometry = rtcNewGeometry(device.get(), RTC_GEOMETRY_TYPE_TRIANGLE);
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, soup.positions.data(), 0,
                               3 * sizeof(float), soup.positions.size() / 3);
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, soup.triangles.data(), 0,
                               3 * sizeof(uint32_t), soup.size());
    rtcSetGeometryBuildQuality(geometry, builder.quality);
    rtcCommitGeometry(geometry);
    const EmbreeScene scene(rtcNewScene(device.get()), rtcReleaseScene);
    rtcSetSceneFlags(scene.get(), builder.flags);
    rtcSetSceneBuildQuality(scene.get(), builder.quality);
    rtcAttachGeometry(scene.get(), geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene.get());
    if (rtcGetDeviceError(device.get()) != RTC_ERROR_NONE) {
        throw std::runtime_error(std::string(builder.name) + " failed");
    }
    return scene;
}

}  // namespace espalier::bench
