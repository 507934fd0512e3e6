// SPDX-License-Identifier: GPL-3.0-or-later
#include "module/compare_job.h"

#include <algorithm>

namespace espalier {
namespace {

template <class Value>
double median(const std::vector<BuildReport>& reports, const Value& value) {
    std::vector<double> values;
    for (const BuildReport& report : reports)
        values.push_back(value(report));
    std::sort(values.begin(), values.end());
    const size_t middle = values.size() / 2;
    return values.size() % 2 == 1 ? values[middle] : 0.5 * (values[middle - 1] + values[middle]);
}

CompareRow summarize(const std::vector<BuildReport>& reports) {
    CompareRow row{reports.back()};
    row.report.build_ms = median(reports, [](const BuildReport& r) { return r.build_ms; });
    for (double PhaseTimes::* phase : {&PhaseTimes::bounds, &PhaseTimes::top_levels, &PhaseTimes::subtrees,
                                       &PhaseTimes::compaction, &PhaseTimes::layout}) {
        row.report.phases_ms.*phase = median(reports, [phase](const BuildReport& r) { return r.phases_ms.*phase; });
    }
    const auto [fastest, slowest] =
        std::minmax_element(reports.begin(), reports.end(),
                            [](const BuildReport& a, const BuildReport& b) { return a.build_ms < b.build_ms; });
    row.build_ms_min = fastest->build_ms;
    row.build_ms_max = slowest->build_ms;
    return row;
}

}  // namespace

CompareJob::CompareJob(std::shared_ptr<const Scene> scene, const std::vector<int>& thread_counts, Quality quality,
                       int repeats)
    : scene_(std::move(scene)), threads_{1}, quality_(quality), repeats_(repeats) {
    threads_.insert(threads_.end(), thread_counts.begin(), thread_counts.end());
}

double CompareJob::progress() const {
    return static_cast<double>(builds_done_.load(std::memory_order_relaxed)) /
           static_cast<double>(threads_.size() * static_cast<size_t>(repeats_));
}

void CompareJob::work() {
    enter(Stage::kComparing);
    std::vector<std::vector<BuildReport>> reports(threads_.size());
    for (int repeat = 0; repeat < repeats_; ++repeat) {
        for (size_t i = 0; i < threads_.size(); ++i) {
            const BuildOptions options{.quality = quality_, .threads = threads_[i], .cancel = &cancel_flag()};
            if (cancel_flag().load(std::memory_order_relaxed))
                throw BuildCancelled();
            reports[i].push_back(build(scene_->soup(), options).report);
            builds_done_.fetch_add(1, std::memory_order_relaxed);
        }
    }
    for (const auto& of_one_count : reports)
        rows_.push_back(summarize(of_one_count));
}

}  // namespace espalier
