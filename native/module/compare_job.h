// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <memory>
#include <vector>

#include "module/job.h"
#include "render/scene.h"

namespace espalier {

/// Repeated builds with one number of threads: the last report, with medians for its times.
struct CompareRow {
    BuildReport report;
    double build_ms_min = 0.0, build_ms_max = 0.0;
};

/// Times the build of a scene's tree, serial and with several numbers of threads. Repeats are interleaved (all numbers
/// once, then all again), so that a slow moment of the machine falls on all of them alike.
class CompareJob final : public Job {
 public:
    CompareJob(std::shared_ptr<const Scene> scene, const std::vector<int>& thread_counts, Quality quality, int repeats);
    ~CompareJob() override { stop(); }

    double progress() const override;

    int repeats() const { return repeats_; }

    /// Serial first, then one row per number of threads in the order given; when done.
    const std::vector<CompareRow>& rows() const { return rows_; }

 private:
    void work() override;

    std::shared_ptr<const Scene> scene_;
    std::vector<int> threads_;
    Quality quality_;
    int repeats_;
    std::atomic<size_t> builds_done_{0};
    std::vector<CompareRow> rows_;
};

}  // namespace espalier
