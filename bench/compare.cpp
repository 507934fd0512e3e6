// SPDX-License-Identifier: GPL-3.0-or-later
// espalier_bench MESH SECONDS [PART...]: one mesh beside Embree, as JSON on standard output. MESH is a file that run.py
// wrote; SECONDS go to each group of contestants; parts are memory, copies=N, quality, builds, rays and preview. The
// instruction set of both sides is what ESPALIER_SIMD says. Without arguments: the instruction sets that this machine
// runs.
#include "compare.h"

#include <cstdio>
#include <exception>
#include <iostream>
#include <set>

#include "embree_rays.h"

namespace espalier::bench {
namespace {

Json compare(const std::string& path, double seconds, const std::set<std::string>& parts) {
    use_fresh_memory();
    const FlushToZero as_embree_asks;  // our side sets and restores its own

    const Mesh mesh = read_mesh(path);
    const int all = hardware_threads();
    Json result{{"triangles", mesh.soup().size()},
                {"threads", all},
                {"simd", simd_target_names().front()},
                {"compiler", "g++ " __VERSION__},
                {"embree", RTC_VERSION_STRING}};
    if (parts.contains("memory")) {
        result["memory"] = compare_memory(mesh, all);
    }
    for (const std::string& part : parts) {
        if (part.starts_with("copies=")) {
            result["large"] = compare_large(mesh, std::stoi(part.substr(part.find('=') + 1)), all, seconds);
        }
    }
    if (parts.contains("quality")) {
        result["quality"] = compare_quality(mesh);
    }
    if (parts.contains("builds")) {
        for (const int threads : std::set{1, all}) {
            result["builds"].push_back(compare_builds(mesh, threads, seconds));
        }
    }
    if (parts.contains("rays")) {
        result["rays"] = compare_rays(mesh, all, seconds);
    }
    if (parts.contains("preview")) {
        result["preview"] = compare_previews(mesh, all, seconds);
    }
    return result;
}

}  // namespace
}  // namespace espalier::bench

int main(int argc, char** argv) {
    using namespace espalier;
    try {
        if (argc == 1) {
            std::cout << bench::Json(simd_target_names()) << "\n";
        } else if (argc > 2) {
            std::cout << bench::compare(argv[1], std::stod(argv[2]), {argv + 3, argv + argc}) << "\n";
        } else {
            std::fputs("usage: espalier_bench [MESH SECONDS [PART...]]\n", stderr);
            return 2;
        }
    } catch (const std::exception& error) {
        std::fprintf(stderr, "espalier_bench: %s\n", error.what());
        return 1;
    }
}
