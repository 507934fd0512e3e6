// SPDX-License-Identifier: GPL-3.0-or-later
#include <pybind11/stl.h>

#include "kdtree/parallel.h"
#include "kdtree/simd_target.h"
#include "module/bindings.h"

PYBIND11_MODULE(espalier_native, module) {
    module.doc() =
        "Ray casting with kd-trees that are built on every core. NumPy arrays in, NumPy arrays out; no Blender "
        "needed.\n\n"
        "build() makes a Tree over triangles, to be asked for hits. Scene, render(), start_preview() and "
        "start_compare()\n"
        "draw placed meshes with a camera and lights, and time the building.";
    module.attr("__version__") = ESPALIER_VERSION;
    module.def("simd_targets", &espalier::simd_target_names,
               "The instruction sets this machine can run, best first; the first is used.\n\n"
               "The environment variable ESPALIER_SIMD, set to one of them before the first call, forces that one.");
    module.def("hardware_threads", &espalier::hardware_threads,
               "How many threads this process may run at the same time: what threads=0 stands for.");
    espalier::bind_tree(module);
    espalier::bind_scene(module);
    espalier::bind_jobs(module);
}
