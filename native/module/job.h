// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <atomic>
#include <condition_variable>
#include <exception>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <thread>

namespace espalier {

/// Ends a job that was told to stop.
class JobCancelled : public std::runtime_error {
 public:
    JobCancelled() : std::runtime_error("the job was cancelled") {}
};

enum class Stage { kPlacing, kBuilding, kTracing, kComparing, kDone, kCancelled, kFailed };

const char* stage_name(Stage stage);

/// Work on a thread of its own that can be watched and cancelled from others. It never touches Python.
/// A kind of job implements work() and progress(), and calls stop() first thing in its destructor.
class Job {
 public:
    Job() = default;
    Job(const Job&) = delete;
    Job& operator=(const Job&) = delete;
    virtual ~Job() = default;

    /// From 0 to 1, never falling.
    virtual double progress() const = 0;

    void start();
    void cancel() { cancel_.store(true, std::memory_order_relaxed); }
    bool done() const { return done_.load(std::memory_order_acquire); }
    Stage stage() const { return stage_.load(std::memory_order_relaxed); }

    /// Waits until the job is done or the time is over, and says whether it is done.
    bool wait_for(double seconds) const;

    /// Cancels, and returns when the thread has ended. May be called more than once.
    void stop();

    /// Throws JobCancelled or what ended the work; call only when done.
    void throw_if_failed() const;

 protected:
    virtual void work() = 0;
    void enter(Stage stage) { stage_.store(stage, std::memory_order_relaxed); }
    const std::atomic<bool>& cancel_flag() const { return cancel_; }

 private:
    void run();

    std::atomic<bool> cancel_{false};
    std::atomic<bool> done_{false};
    std::atomic<Stage> stage_{Stage::kPlacing};
    std::exception_ptr error_;
    mutable std::mutex mutex_;
    mutable std::condition_variable ended_;
    std::mutex join_mutex_;
    std::thread thread_;
};

/// Starts the job, and has stop_all_jobs() stop it should it still run by then.
void start_job(const std::shared_ptr<Job>& job);

/// Stops every job that is still alive: at the interpreter's exit no thread may be left working.
void stop_all_jobs();

}  // namespace espalier
