// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <memory>
#include <vector>

#include "module/job.h"
#include "render/render.h"

namespace espalier {

/// Builds the tree of a scene and draws its picture.
class PreviewJob final : public Job {
 public:
    PreviewJob(std::shared_ptr<const Scene> scene, const Camera& camera, std::vector<Light> lights, int width,
               int height, Quality quality, bool on_demand, const RenderSettings& settings)
        : scene_(std::move(scene)),
          camera_(camera),
          lights_(std::move(lights)),
          film_(width, height),
          quality_(quality),
          on_demand_(on_demand),
          settings_(settings) {}
    ~PreviewJob() override { stop(); }

    double progress() const override;

    const Scene& scene() const { return *scene_; }
    const Film& film() const { return film_; }
    const BuildReport& build_report() const { return build_report_; }  // when done
    const TraceReport& trace_report() const { return trace_report_; }  // when done

 private:
    void work() override;

    std::shared_ptr<const Scene> scene_;
    Camera camera_;
    std::vector<Light> lights_;
    Film film_;
    Quality quality_;
    bool on_demand_;
    RenderSettings settings_;
    std::atomic<bool> built_{false};
    BuildReport build_report_;
    TraceReport trace_report_;
};

}  // namespace espalier
