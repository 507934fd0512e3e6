// SPDX-License-Identifier: GPL-3.0-or-later
#include <pybind11/stl.h>

#include "kdtree/parallel.h"
#include "kdtree/simd_target.h"
#include "module/bindings.h"
#include "module/docs.h"

PYBIND11_MODULE(espalier_native, module) {
    namespace docs = espalier::docs;
    module.doc() = docs::kModule;
    module.attr("__version__") = ESPALIER_VERSION;
    module.def("simd_targets", &espalier::simd_target_names, docs::kSimdTargets);
    module.def("hardware_threads", &espalier::hardware_threads, docs::kHardwareThreads);
    espalier::bind_tree(module);
    espalier::bind_scene(module);
    espalier::bind_jobs(module);
}
