// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <pybind11/pybind11.h>

#include "module/compare_job.h"
#include "module/preview_job.h"

namespace espalier {

Quality quality_from(const std::string& name);

pybind11::dict report_dict(const BuildReport& report);
pybind11::dict precision_dict(const Precision& precision);
pybind11::list objects_list(const Scene& scene);
pybind11::dict preview_dict(const PreviewJob& job);
pybind11::dict compare_dict(const CompareJob& job);

/// The finished tiles as float32 [H, W, 4].
pybind11::object image_array(const Film& film);

}  // namespace espalier
