// SPDX-License-Identifier: GPL-3.0-or-later
#include "module/preview_job.h"

#include "kdtree/on_demand.h"

namespace espalier {
namespace {

/// A share of the bar for the build, which cannot say how far it is.
constexpr double kBuildShare = 0.1;

}  // namespace

double PreviewJob::progress() const {
    return built_.load(std::memory_order_relaxed) ? kBuildShare + (1.0 - kBuildShare) * film_.progress() : 0.0;
}

void PreviewJob::work() {
    enter(Stage::kBuilding);
    const Tree tree = build(scene_->soup(), {.quality = quality_,
                                             .threads = settings_.threads,
                                             .cancel = &cancel_flag(),
                                             .on_demand_from = on_demand_ ? kOnDemandPays : UINT32_MAX});
    build_report_ = tree.report;
    built_.store(true, std::memory_order_relaxed);
    enter(Stage::kTracing);
    trace_report_ = render_picture(*scene_, tree, camera_, lights_, settings_, film_, cancel_flag());
    if (tree.on_demand) {
        build_report_.subtrees = tree.on_demand->subtrees();
        build_report_.opened = tree.on_demand->opened();
    }
}

}  // namespace espalier
