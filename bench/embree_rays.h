// SPDX-License-Identifier: GPL-3.0-or-later
// Embree's calls for rays: one, a packet of 4, 8 or 16, and a stream.
#pragma once

#include <embree3/rtcore.h>
#include <pmmintrin.h>
#include <xmmintrin.h>

#include <algorithm>
#include <type_traits>

#include "rays.h"

namespace espalier::bench {

constexpr uint32_t kNoFace = RTC_INVALID_GEOMETRY_ID;

/// While it lives, this thread flushes subnormals to zero, as Embree asks of its callers.
class FlushToZero {
 public:
    FlushToZero() : saved_(_mm_getcsr()) {
        _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
        _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
    }
    ~FlushToZero() { _mm_setcsr(saved_); }
    FlushToZero(const FlushToZero&) = delete;
    FlushToZero& operator=(const FlushToZero&) = delete;

 private:
    uint32_t saved_;
};

inline RTCIntersectContext new_context(bool coherent) {
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    context.flags = coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
    return context;
}

template <int kWidth>
struct Packet;
template <>
struct Packet<4> {
    using Rays = RTCRay4;
    using RayHits = RTCRayHit4;
    static constexpr auto kIntersect = rtcIntersect4;
    static constexpr auto kOccluded = rtcOccluded4;
};
template <>
struct Packet<8> {
    using Rays = RTCRay8;
    using RayHits = RTCRayHit8;
    static constexpr auto kIntersect = rtcIntersect8;
    static constexpr auto kOccluded = rtcOccluded8;
};
template <>
struct Packet<16> {
    using Rays = RTCRay16;
    using RayHits = RTCRayHit16;
    static constexpr auto kIntersect = rtcIntersect16;
    static constexpr auto kOccluded = rtcOccluded16;
};

/// Calls f with the width of packets that the device traces natively, as a constant.
template <class F>
void with_native_width(const RTCDevice device, const F& f) {
    if (rtcGetDeviceProperty(device, RTC_DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED) != 0) {
        f(std::integral_constant<int, 16>());
    } else if (rtcGetDeviceProperty(device, RTC_DEVICE_PROPERTY_NATIVE_RAY8_SUPPORTED) != 0) {
        f(std::integral_constant<int, 8>());
    } else {
        f(std::integral_constant<int, 4>());
    }
}

template <class Rays>
void put(Rays& rays, size_t lane, const Ray& ray) {
    rays.org_x[lane] = ray.origin.x;
    rays.org_y[lane] = ray.origin.y;
    rays.org_z[lane] = ray.origin.z;
    rays.tnear[lane] = ray.t_min;
    rays.dir_x[lane] = ray.direction.x;
    rays.dir_y[lane] = ray.direction.y;
    rays.dir_z[lane] = ray.direction.z;
    rays.time[lane] = 0;
    rays.tfar[lane] = ray.t_max;
    rays.mask[lane] = ~0U;
    rays.id[lane] = 0;
    rays.flags[lane] = 0;
}

inline RTCRay embree_ray(const Ray& ray) {
    return {ray.origin.x,
            ray.origin.y,
            ray.origin.z,
            ray.t_min,
            ray.direction.x,
            ray.direction.y,
            ray.direction.z,
            0,
            ray.t_max,
            ~0U,
            0,
            0};
}

/// What Embree leaves of a set: distances, coordinates and faces, or, for any hit, 1 in `face` where there was one.
struct EmbreeHits {
    explicit EmbreeHits(size_t count) : t(count), u(count), v(count), face(count) {}
    std::vector<float> t, u, v;
    std::vector<uint32_t> face;
};

/// Rays one at a time, from Embree's own struct.
class EmbreeSingle {
 public:
    EmbreeSingle(RTCScene scene, const RaySet& set) : scene_(scene), set_(set), hits(set.rays.size()) {
        std::transform(set.rays.begin(), set.rays.end(), std::back_inserter(rays_), embree_ray);
    }
    double run(int threads) {
        return trace_chunks(set_, threads, [&](size_t first, size_t count) {
            const FlushToZero flush;
            RTCIntersectContext context = new_context(set_.coherent);
            for (size_t i = first; i < first + count; ++i) {
                if (set_.any_hit) {
                    RTCRay ray = rays_[i];
                    rtcOccluded1(scene_, &context, &ray);
                    hits.face[i] = ray.tfar < 0 ? 1 : 0;
                    continue;
                }
                RTCRayHit ray{rays_[i], {}};
                ray.hit.primID = ray.hit.geomID = kNoFace;
                rtcIntersect1(scene_, &context, &ray);
                hits.t[i] = ray.ray.tfar;
                hits.u[i] = ray.hit.u;
                hits.v[i] = ray.hit.v;
                hits.face[i] = ray.hit.primID;
            }
        });
    }

 private:
    RTCScene scene_;
    const RaySet& set_;
    std::vector<RTCRay> rays_;

 public:
    EmbreeHits hits;
};

/// Closest hits in streams of 256, from Embree's own struct.
class EmbreeStream {
 public:
    EmbreeStream(RTCScene scene, const RaySet& set) : scene_(scene), set_(set), hits(set.rays.size()) {
        std::transform(set.rays.begin(), set.rays.end(), std::back_inserter(rays_), embree_ray);
    }
    double run(int threads) {
        return trace_chunks(set_, threads, [&](size_t first, size_t count) {
            const FlushToZero flush;
            RTCIntersectContext context = new_context(set_.coherent);
            for (size_t begin = first; begin < first + count; begin += kLength) {
                RTCRayHit stream[kLength];
                for (size_t i = 0; i < kLength; ++i) {
                    stream[i].ray = rays_[begin + i];
                    stream[i].hit.primID = stream[i].hit.geomID = kNoFace;
                }
                rtcIntersect1M(scene_, &context, stream, kLength, sizeof(RTCRayHit));
                for (size_t i = 0; i < kLength; ++i) {
                    hits.t[begin + i] = stream[i].ray.tfar;
                    hits.u[begin + i] = stream[i].hit.u;
                    hits.v[begin + i] = stream[i].hit.v;
                    hits.face[begin + i] = stream[i].hit.primID;
                }
            }
        });
    }

 private:
    static constexpr size_t kLength = 256;
    RTCScene scene_;
    const RaySet& set_;
    std::vector<RTCRay> rays_;

 public:
    EmbreeHits hits;
};

/// Packets, from Embree's own structs of arrays.
template <int kWidth>
class EmbreePackets {
 public:
    EmbreePackets(RTCScene scene, const RaySet& set)
        : scene_(scene), set_(set), packets_(set.rays.size() / kWidth), hits(set.rays.size()) {
        for (size_t i = 0; i < set.rays.size(); ++i) {
            put(packets_[i / kWidth], i % kWidth, set.rays[i]);
        }
    }
    double run(int threads) {
        return trace_chunks(set_, threads, [&](size_t first, size_t count) {
            const FlushToZero flush;
            RTCIntersectContext context = new_context(set_.coherent);
            alignas(64) int valid[kWidth];
            std::fill_n(valid, kWidth, -1);
            for (size_t i = first; i < first + count; i += kWidth) {
                typename Packet<kWidth>::RayHits packet;
                packet.ray = packets_[i / kWidth];
                if (set_.any_hit) {
                    Packet<kWidth>::kOccluded(valid, scene_, &context, &packet.ray);
                    for (size_t lane = 0; lane < kWidth; ++lane) {
                        hits.face[i + lane] = packet.ray.tfar[lane] < 0 ? 1 : 0;
                    }
                    continue;
                }
                std::fill_n(packet.hit.primID, kWidth, kNoFace);
                std::fill_n(packet.hit.geomID, kWidth, kNoFace);
                Packet<kWidth>::kIntersect(valid, scene_, &context, &packet);
                std::copy_n(packet.ray.tfar, kWidth, &hits.t[i]);
                std::copy_n(packet.hit.u, kWidth, &hits.u[i]);
                std::copy_n(packet.hit.v, kWidth, &hits.v[i]);
                std::copy_n(packet.hit.primID, kWidth, &hits.face[i]);
            }
        });
    }

 private:
    RTCScene scene_;
    const RaySet& set_;
    std::vector<typename Packet<kWidth>::Rays> packets_;

 public:
    EmbreeHits hits;
};

}  // namespace espalier::bench
