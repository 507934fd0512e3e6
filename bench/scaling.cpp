// SPDX-License-Identifier: GPL-3.0-or-later
// espalier_scaling MESH SECONDS: our builds and rays on 1, 2, 4 ... threads, as JSON on standard output. It stands
// alone, so that it can be taken to a machine with more cores. MESH is a file that run.py wrote; SECONDS go to each
// group of contestants.
#include <malloc.h>

#include <cstdio>
#include <exception>
#include <iostream>

#include "kdtree/simd_target.h"
#include "rays.h"

namespace espalier::bench {
namespace {

std::vector<int> thread_counts() {
    std::vector<int> counts;
    for (int count = 1; count <= hardware_threads(); count *= 2) {
        counts.push_back(count);
    }
    return counts;
}

Json scale_build(const Mesh& mesh, const Mode& mode, double seconds) {
    std::vector<Contestant> contestants;
    for (const int threads : thread_counts()) {
        build(sample_of(mesh).soup(), {.quality = mode.quality, .threads = threads});  // loads code, makes threads
        contestants.emplace_back(mode.name, threads, [&mesh, &mode, threads] {
            malloc_trim(0);
            return build(mesh.soup(), {.quality = mode.quality, .threads = threads}).report.build_ms;
        });
    }
    take_turns(contestants, seconds);
    return {{"what", std::string("build, ") + mode.name}, {"rows", rows_of(contestants)}};
}

Json scale_rays(const Tree& tree, const RaySet& set, double seconds) {
    Found found(set);
    std::vector<Contestant> contestants;
    for (const int threads : thread_counts()) {
        contestants.emplace_back(set.name, threads, [&, threads] { return trace_ours(tree, set, threads, found); });
    }
    take_turns(contestants, seconds);
    return {{"what", std::string("rays, ") + set.name}, {"rows", rows_of(contestants)}};
}

Json scale(const std::string& path, double seconds) {
    use_fresh_memory();
    const Mesh mesh = read_mesh(path);
    Json groups;
    for (const Mode& mode : kModes) {
        groups.push_back(scale_build(mesh, mode, seconds));
    }
    const Tree tree = build(mesh.soup(), {.quality = kModes[kDefaultMode].quality});
    for (const RaySet& set : make_rays(mesh, tree)) {
        if (!set.rays.empty()) {
            groups.push_back(scale_rays(tree, set, seconds));
        }
    }
    return {{"triangles", mesh.soup().size()},
            {"simd", simd_target_names().front()},
            {"compiler", "g++ " __VERSION__},
            {"scaling", groups}};
}

}  // namespace
}  // namespace espalier::bench

int main(int argc, char** argv) {
    if (argc != 3) {
        std::fputs("usage: espalier_scaling MESH SECONDS\n", stderr);
        return 2;
    }
    try {
        std::cout << espalier::bench::scale(argv[1], std::stod(argv[2])) << "\n";
    } catch (const std::exception& error) {
        std::fprintf(stderr, "espalier_scaling: %s\n", error.what());
        return 1;
    }
}
