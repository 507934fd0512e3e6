// SPDX-License-Identifier: GPL-3.0-or-later
#include "module/job.h"

#include <algorithm>
#include <chrono>
#include <vector>

#include "geometry/float_environment.h"
#include "kdtree/tree.h"
#include "render/render.h"

namespace espalier {
namespace {

struct LiveJobs {
    std::mutex mutex;
    std::vector<std::weak_ptr<Job>> jobs;
};

LiveJobs& live_jobs() {
    static LiveJobs live;
    return live;
}

}  // namespace

const char* stage_name(Stage stage) {
    switch (stage) {
        case Stage::kPlacing:
            return "placing";
        case Stage::kBuilding:
            return "building";
        case Stage::kTracing:
            return "tracing";
        case Stage::kComparing:
            return "comparing";
        case Stage::kDone:
            return "done";
        case Stage::kCancelled:
            return "cancelled";
        case Stage::kFailed:
            return "failed";
    }
    return "";
}

void Job::start() { thread_ = std::thread(&Job::run, this); }

void Job::run() {
    const FloatEnvironment environment;
    Stage end = Stage::kDone;
    try {
        work();
    } catch (const BuildCancelled&) {
        end = Stage::kCancelled;
    } catch (const RenderCancelled&) {
        end = Stage::kCancelled;
    } catch (...) {
        error_ = std::current_exception();
        end = Stage::kFailed;
    }
    enter(end);
    const std::lock_guard lock(mutex_);
    done_.store(true, std::memory_order_release);
    ended_.notify_all();
}

bool Job::wait_for(double seconds) const {
    std::unique_lock lock(mutex_);
    return ended_.wait_for(lock, std::chrono::duration<double>(seconds), [this] { return done(); });
}

void Job::stop() {
    cancel();
    const std::lock_guard lock(join_mutex_);
    if (thread_.joinable())
        thread_.join();
}

void Job::throw_if_failed() const {
    if (stage() == Stage::kCancelled)
        throw JobCancelled();
    if (error_)
        std::rethrow_exception(error_);
}

void start_job(const std::shared_ptr<Job>& job) {
    LiveJobs& live = live_jobs();
    {
        const std::lock_guard lock(live.mutex);
        std::erase_if(live.jobs, [](const auto& other) { return other.expired(); });
        live.jobs.push_back(job);
    }
    job->start();
}

void stop_all_jobs() {
    LiveJobs& live = live_jobs();
    std::vector<std::shared_ptr<Job>> jobs;
    {
        const std::lock_guard lock(live.mutex);
        for (const auto& weak : live.jobs) {
            if (auto job = weak.lock())
                jobs.push_back(std::move(job));
        }
    }
    for (const auto& job : jobs)
        job->cancel();
    for (const auto& job : jobs)
        job->stop();
}

}  // namespace espalier
