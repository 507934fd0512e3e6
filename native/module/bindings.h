// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <pybind11/pybind11.h>

namespace espalier {

void bind_tree(pybind11::module_& module);
void bind_scene(pybind11::module_& module);
void bind_jobs(pybind11::module_& module);

}  // namespace espalier
