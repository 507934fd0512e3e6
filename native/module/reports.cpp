// SPDX-License-Identifier: GPL-3.0-or-later
#include "module/reports.h"

#include <pybind11/numpy.h>

#include <cstdio>

namespace py = pybind11;
using namespace py::literals;

namespace espalier {
namespace {

std::string hexadecimal(uint64_t bits) {
    char text[17];
    std::snprintf(text, sizeof text, "%016llx", static_cast<unsigned long long>(bits));
    return text;
}

py::dict phases_dict(const PhaseTimes& phases) {
    return py::dict("bounds"_a = phases.bounds, "top_levels"_a = phases.top_levels, "subtrees"_a = phases.subtrees,
                    "compaction"_a = phases.compaction, "layout"_a = phases.layout);
}

py::dict rejected_dict(const RejectedFaces& rejected) {
    return py::dict("not_finite"_a = rejected.not_finite, "no_area"_a = rejected.no_area,
                    "too_large"_a = rejected.too_large);
}

py::dict lost_dict(const ObjectSummary& object) {
    py::dict lost;
    if (object.in_mesh.ulp_per_edge() > kLostShape)
        lost["mesh"] = precision_dict(object.in_mesh);
    if (object.in_placement.ulp_per_edge() > kLostPlace)
        lost["placement"] = precision_dict(object.in_placement);
    if (object.in_scene.ulp_per_edge() > kLostShape)
        lost["scene"] = precision_dict(object.in_scene);
    return lost;
}

py::dict row_dict(const CompareRow& row, const CompareRow& serial, int repeats) {
    const BuildReport& report = row.report;
    py::dict result = report_dict(report);
    const auto triangles = static_cast<double>(report.triangles);
    const double speed_up = report.build_ms > 0.0 ? serial.report.build_ms / report.build_ms : 1.0;
    result["build_ms_min"] = row.build_ms_min;
    result["build_ms_max"] = row.build_ms_max;
    result["repeats"] = repeats;
    result["speed_up"] = speed_up;
    result["efficiency"] = speed_up / report.threads;
    result["mtri_per_s"] = report.build_ms > 0.0 ? triangles / report.build_ms * 1e-3 : 0.0;
    result["references_per_triangle"] = triangles > 0.0 ? static_cast<double>(report.references) / triangles : 0.0;
    return result;
}

}  // namespace

Quality quality_from(const std::string& name) {
    if (name == "draft")
        return Quality::kDraft;
    if (name == "balanced")
        return Quality::kBalanced;
    if (name == "best")
        return Quality::kBest;
    if (name == "exact")
        return Quality::kExact;
    throw py::value_error("quality must be 'draft', 'balanced', 'best' or 'exact', not '" + name + "'");
}

py::dict report_dict(const BuildReport& report) {
    const SahConstants& sah = report.sah_constants;
    return py::dict(
        "build_ms"_a = report.build_ms, "phases_ms"_a = phases_dict(report.phases_ms), "threads"_a = report.threads,
        "triangles"_a = report.triangles, "nodes"_a = report.nodes, "leaves"_a = report.leaves,
        "empty_leaves"_a = report.empty_leaves, "references"_a = report.references, "wide_nodes"_a = report.wide_nodes,
        "subtrees"_a = report.subtrees, "opened"_a = report.opened, "bytes"_a = report.bytes,
        "sah_cost"_a = report.sah_cost,
        "sah_constants"_a = py::dict("traversal"_a = sah.traversal, "block"_a = sah.block,
                                     "empty_bonus"_a = sah.empty_bonus, "max_depth"_a = sah.max_depth),
        "checksum"_a = hexadecimal(report.checksum), "rejected_faces"_a = rejected_dict(report.rejected_faces));
}

py::dict precision_dict(const Precision& precision) {
    return py::dict("distance_m"_a = precision.distance, "ulp_m"_a = precision.ulp, "median_edge_m"_a = precision.edge,
                    "ulp_per_median_edge"_a = precision.ulp_per_edge());
}

py::list objects_list(const Scene& scene) {
    py::list list;
    for (const ObjectSummary& object : scene.objects()) {
        list.append(py::dict("object"_a = object.object, "triangles"_a = object.triangles,
                             "rejected_faces"_a = rejected_dict(object.rejected),
                             "lost_precision"_a = lost_dict(object)));
    }
    return list;
}

py::object image_array(const Film& film) {
    py::array_t<float> image({film.height(), film.width(), 4});
    const std::span<float> pixels(image.mutable_data(), static_cast<size_t>(image.size()));
    const py::gil_scoped_release release;
    film.copy_finished(pixels);
    return image;
}

py::dict preview_dict(const PreviewJob& job) {
    const TraceReport& trace = job.trace_report();
    return py::dict("image"_a = image_array(job.film()), "build"_a = report_dict(job.build_report()),
                    "trace"_a = py::dict("trace_ms"_a = trace.trace_ms, "threads"_a = trace.threads,
                                         "samples"_a = trace.samples, "primary_rays"_a = trace.primary_rays,
                                         "shadow_rays"_a = trace.shadow_rays, "mrays_per_s"_a = trace.mrays_per_s),
                    "placing_ms"_a = job.scene().placing_ms(), "objects"_a = objects_list(job.scene()));
}

py::dict compare_dict(const CompareJob& job) {
    const std::vector<CompareRow>& rows = job.rows();
    py::list threads;
    for (size_t i = 1; i < rows.size(); ++i)
        threads.append(row_dict(rows[i], rows[0], job.repeats()));
    return py::dict("triangles"_a = rows[0].report.triangles, "serial"_a = row_dict(rows[0], rows[0], job.repeats()),
                    "threads"_a = threads);
}

}  // namespace espalier
