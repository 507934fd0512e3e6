// SPDX-License-Identifier: GPL-3.0-or-later
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <set>
#include <vector>

#include "module/arrays.h"
#include "module/bindings.h"
#include "module/docs.h"
#include "module/fields.h"
#include "module/reports.h"

namespace py = pybind11;
using namespace py::literals;

namespace espalier {
namespace {

constexpr int kMaxSide = 65536;
constexpr int kMaxSamples = 65536;
constexpr double kSignalInterval = 0.05;  // s between looks for Ctrl-C while Python waits

void require_between(int value, int low, int high, const char* name) {
    if (value < low || value > high) {
        throw py::value_error(std::string(name) + " must be between " + std::to_string(low) + " and " +
                              std::to_string(high) + ", not " + std::to_string(value));
    }
}

Vec3d color_from(const std::array<double, 3>& rgb) { return {rgb[0], rgb[1], rgb[2]}; }

Camera camera_from(py::handle value, Vec3d scene_centre) {
    const Fields fields(value, "camera");
    const auto type = fields.required<std::string>("type");
    if (type != "PERSP" && type != "ORTHO") {
        throw py::value_error("camera: type must be 'PERSP' or 'ORTHO', not '" + type + "'");
    }
    return {type == "PERSP" ? Projection::kPerspective : Projection::kOrthographic,
            matrix_from(fields.at("matrix_world"), "camera: matrix_world"),
            matrix_from(fields.at("projection"), "camera: projection"), scene_centre};
}

AreaShape shape_from(const std::string& shape, const std::string& place) {
    if (shape == "SQUARE" || shape == "RECTANGLE")
        return AreaShape::kRectangle;
    if (shape == "DISK" || shape == "ELLIPSE")
        return AreaShape::kEllipse;
    throw py::value_error(place + ": shape must be 'SQUARE', 'RECTANGLE', 'DISK' or 'ELLIPSE', not '" + shape + "'");
}

LightInput light_input(const Fields& fields) {
    LightInput light;
    const auto type = fields.required<std::string>("type");
    light.matrix = matrix_from(fields.at("matrix"), fields.place() + ": matrix");
    light.color = color_from(fields.required<std::array<double, 3>>("color"));
    light.energy = fields.required<double>("energy");
    light.shadow = fields.value_or("shadow", true);
    if (type == "POINT" || type == "SPOT") {
        light.kind = LightKind::kPoint;
        light.radius = fields.value_or("radius", 0.0);
        if (type == "SPOT") {
            light.kind = LightKind::kSpot;
            light.spot_size = fields.required<double>("spot_size");
            light.spot_blend = fields.value_or("spot_blend", 0.0);
        }
    } else if (type == "SUN") {
        light.kind = LightKind::kSun;
        light.angle = fields.value_or("angle", 0.0);
    } else if (type == "AREA") {
        const auto shape = fields.value_or<std::string>("shape", "SQUARE");
        light.kind = LightKind::kArea;
        light.shape = shape_from(shape, fields.place());
        light.size = fields.required<double>("size");
        light.size_y = shape == "SQUARE" || shape == "DISK" ? light.size : fields.required<double>("size_y");
    } else {
        throw py::value_error(fields.place() + ": type must be 'POINT', 'SUN', 'SPOT' or 'AREA', not '" + type + "'");
    }
    return light;
}

std::vector<Light> lights_from(const py::sequence& list, Vec3d scene_centre) {
    std::vector<Light> lights;
    for (size_t i = 0; i < list.size(); ++i) {
        const Fields fields(list[i], "lights", i);
        try {
            lights.emplace_back(light_input(fields), scene_centre);
        } catch (const std::invalid_argument& error) {
            throw py::value_error(fields.place() + ": " + error.what());
        }
    }
    return lights;
}

std::shared_ptr<Job> start_preview(const std::shared_ptr<Scene>& scene, py::handle camera, const py::sequence& lights,
                                   const std::array<double, 3>& world_color, int width, int height,
                                   const std::string& quality, int threads, int samples, bool on_demand) {
    require_between(width, 1, kMaxSide, "width");
    require_between(height, 1, kMaxSide, "height");
    require_between(samples, 1, kMaxSamples, "samples");
    const RenderSettings settings{color_from(world_color), samples, checked_threads(threads)};
    if (!is_finite(settings.world_color))
        throw py::value_error("world_color must be finite");
    auto job =
        std::make_shared<PreviewJob>(scene, camera_from(camera, scene->centre()), lights_from(lights, scene->centre()),
                                     width, height, quality_from(quality), on_demand, settings);
    start_job(job);
    return job;
}

std::shared_ptr<Job> start_compare(const std::shared_ptr<Scene>& scene, const std::vector<int>& thread_counts,
                                   const std::string& quality, int repeats) {
    require_between(repeats, 1, 1000, "repeats");
    if (thread_counts.empty())
        throw py::value_error("thread_counts must name at least one number of threads");
    for (const int threads : thread_counts) {
        if (checked_threads(threads, "thread_counts") == 0)
            throw py::value_error("thread_counts must be positive");
    }
    if (std::set<int>(thread_counts.begin(), thread_counts.end()).size() != thread_counts.size()) {
        throw py::value_error("thread_counts must not repeat a number");
    }
    auto job = std::make_shared<CompareJob>(scene, thread_counts, quality_from(quality), repeats);
    start_job(job);
    return job;
}

/// Waits without the GIL, coming back now and then for signals, so that Ctrl-C is heard.
bool wait_for_job(const Job& job, std::optional<double> timeout) {
    double left = timeout.value_or(std::numeric_limits<double>::infinity());
    if (std::isnan(left))
        throw py::value_error("timeout must be a number of seconds or None");
    while (true) {
        const double step = std::clamp(left, 0.0, kSignalInterval);
        {
            const py::gil_scoped_release release;
            if (job.wait_for(step))
                return true;
        }
        if (PyErr_CheckSignals() != 0)
            throw py::error_already_set();
        left -= step;
        if (left <= 0.0)
            return false;
    }
}

py::dict result_of(const Job& job) {
    wait_for_job(job, std::nullopt);
    job.throw_if_failed();
    if (const auto* preview = dynamic_cast<const PreviewJob*>(&job))
        return preview_dict(*preview);
    return compare_dict(dynamic_cast<const CompareJob&>(job));
}

py::object image_of(const Job& job) {
    const auto* preview = dynamic_cast<const PreviewJob*>(&job);
    if (preview == nullptr || preview->film().progress() == 0.0)
        return py::none();
    return image_array(preview->film());
}

py::dict render(const std::shared_ptr<Scene>& scene, py::handle camera, const py::sequence& lights,
                const std::array<double, 3>& world_color, int width, int height, const std::string& quality,
                int threads, int samples, bool on_demand) {
    return result_of(
        *start_preview(scene, camera, lights, world_color, width, height, quality, threads, samples, on_demand));
}

}  // namespace

void bind_jobs(py::module_& module) {
    py::register_exception<JobCancelled>(module, "Cancelled", PyExc_RuntimeError).doc() = docs::kCancelled;
    py::class_<Job, std::shared_ptr<Job>>(module, "Job", docs::kJob)
        .def_property_readonly("progress", &Job::progress, docs::kProgress)
        .def_property_readonly(
            "stage", [](const Job& job) { return stage_name(job.stage()); }, docs::kStage)
        .def_property_readonly("done", &Job::done, docs::kDone)
        .def("cancel", &Job::cancel, docs::kCancel)
        .def("wait", &wait_for_job, "timeout"_a = py::none(), docs::kWait)
        .def("result", &result_of, docs::kResult)
        .def("image", &image_of, docs::kImage);

    module.def("start_preview", &start_preview, "scene"_a, "camera"_a, "lights"_a, "world_color"_a, "width"_a,
               "height"_a, py::kw_only(), "quality"_a = "balanced", "threads"_a = 0, "samples"_a = 4,
               "on_demand"_a = false, docs::kStartPreview);
    module.def("render", &render, "scene"_a, "camera"_a, "lights"_a, "world_color"_a, "width"_a, "height"_a,
               py::kw_only(), "quality"_a = "balanced", "threads"_a = 0, "samples"_a = 4, "on_demand"_a = false,
               docs::kRender);
    module.def("start_compare", &start_compare, "scene"_a, "thread_counts"_a, py::kw_only(), "quality"_a = "balanced",
               "repeats"_a = 5, docs::kStartCompare);

    // At the interpreter's exit no thread may be left working on what is about to go.
    py::module_::import("atexit").attr("register")(py::cpp_function([] {
        const py::gil_scoped_release release;
        stop_all_jobs();
    }));
}

}  // namespace espalier
