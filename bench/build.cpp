// SPDX-License-Identifier: GPL-3.0-or-later
// Builds: time, phases, quality and memory, with Embree's builders beside ours.
#include <malloc.h>
#include <sys/wait.h>
#include <unistd.h>

#include <fstream>

#include "compare.h"

namespace espalier::bench {
namespace {

double half_area(const Box3f& box) {
    const Vec3d size = to_double(box.upper) - to_double(box.lower);
    return size.x * size.y + size.y * size.z + size.z * size.x;
}

/// What a random ray that meets the scene's box may expect, by the surface-area heuristic.
struct Expected {
    double steps = 0;
    double blocks = 0;
    double triangles = 0;
};

void add_areas(const Tree& tree, uint32_t index, const Box3f& cell, Expected& sum) {
    const KdNode node = tree.nodes[index];
    const double area = half_area(cell);
    if (node.is_leaf()) {
        sum.blocks += area * block_count(node.references());
        sum.triangles += area * node.references();
        return;
    }
    sum.steps += area;
    Box3f left = cell;
    Box3f right = cell;
    left.upper[node.axis()] = node.split();
    right.lower[node.axis()] = node.split();
    add_areas(tree, index + 1, left, sum);
    add_areas(tree, node.right_child(), right, sum);
}

/// The cost of blocks of eight, and that of the literature (Wald and Havran 2006).
Json quality_of(const Tree& tree) {
    constexpr double kStep = 15;
    constexpr double kTriangle = 20;
    Expected sum;
    add_areas(tree, 0, tree.bounds, sum);
    const double area = half_area(tree.bounds);
    const BuildReport& report = tree.report;
    char checksum[17];
    std::snprintf(checksum, sizeof checksum, "%016llx", static_cast<unsigned long long>(report.checksum));
    return {{"step", report.sah_constants.traversal},
            {"block", report.sah_constants.block},
            {"sah_block", report.sah_cost},
            {"sah_classic", (kStep * sum.steps + kTriangle * sum.triangles) / area},
            {"nodes", report.nodes},
            {"wide_nodes", report.wide_nodes},
            {"references_per_triangle", static_cast<double>(report.references) / report.triangles},
            {"checksum", checksum}};
}

/// Our builder, with the phases of each run.
class OurBuilds {
 public:
    OurBuilds(const TriangleSoup& soup, const Mode& mode, int threads) : soup_(soup), mode_(mode), threads_(threads) {}

    /// The builder's own clock: without quality and checksum, which are for the report.
    double run() {
        constexpr const char* kPhases[] = {"bounds", "top_levels", "subtrees", "compaction", "layout"};
        malloc_trim(0);
        const Tree tree = build(soup_, {.quality = mode_.quality, .threads = threads_});
        const PhaseTimes& phases = tree.report.phases_ms;
        const double values[] = {phases.bounds, phases.top_levels, phases.subtrees, phases.compaction, phases.layout};
        for (size_t i = 0; i < std::size(values); ++i) {
            phases_ms_[kPhases[i]].push_back(values[i]);
        }
        return tree.report.build_ms;
    }
    const Json& phases_ms() const { return phases_ms_; }

 private:
    TriangleSoup soup_;
    Mode mode_;
    int threads_;
    Json phases_ms_;  ///< per phase, of each run
};

double time_embree(const Device& device, const TriangleSoup& soup, const EmbreeBuilder& builder) {
    malloc_trim(0);
    const Stopwatch watch;
    const EmbreeScene scene = build_embree(device, soup, builder);
    return watch.ms();
}

void warm_up(const Mesh& mesh, const Device& device, int threads) {
    const Mesh sample = sample_of(mesh);
    for (const Mode& mode : kModes) {
        build(sample.soup(), {.quality = mode.quality, .threads = threads});
    }
    for (const EmbreeBuilder& builder : kEmbreeBuilders) {
        build_embree(device, sample.soup(), builder);
    }
}

/// Kilobytes of a field of /proc/self/status.
double status_kb(const std::string& field) {
    std::ifstream status("/proc/self/status");
    for (std::string line; std::getline(status, line);) {
        if (line.starts_with(field + ":")) {
            return std::stod(line.substr(field.size() + 1));
        }
    }
    throw std::runtime_error("/proc/self/status has no " + field);
}

/// Runs `build` in a child process of its own, after `warm_up`: what it adds to the resident size at most, and in the
/// end. What it returns is held until both are read.
template <class WarmUp, class Build>
Json memory_in_child(const std::string& name, int threads, const WarmUp& warm_up, const Build& build) {
    int ends[2];
    if (::pipe(ends) != 0) {
        throw std::runtime_error("no pipe to a child process");
    }
    const pid_t child = ::fork();
    if (child == 0) {
        warm_up();
        malloc_trim(0);
        std::ofstream("/proc/self/clear_refs") << "5";  // the peak starts again; where forbidden it is the warm-up's
        const double resident = status_kb("VmRSS");
        const double anonymous = status_kb("RssAnon");
        const auto held = build();
        malloc_trim(0);
        const double mb[] = {(status_kb("VmHWM") - resident) / 1024, (status_kb("RssAnon") - anonymous) / 1024};
        ::_exit(::write(ends[1], mb, sizeof mb) == sizeof mb ? 0 : 1);
    }
    ::close(ends[1]);
    double mb[2];
    const bool read = ::read(ends[0], mb, sizeof mb) == sizeof mb;
    ::close(ends[0]);
    ::waitpid(child, nullptr, 0);
    if (!read) {
        throw std::runtime_error("the child process that measures the memory of " + name + " failed");
    }
    return {{"name", name}, {"threads", threads}, {"peak_mb", mb[0]}, {"kept_mb", mb[1]}};
}

Json memory_of_ours(const Mesh& mesh, const Mode& mode, int threads) {
    const BuildOptions options{.quality = mode.quality, .threads = threads};
    return memory_in_child(
        mode.name, threads, [&] { build(sample_of(mesh).soup(), options); },
        [&] { return build(mesh.soup(), options); });
}

Json memory_of_embree(const Mesh& mesh, const EmbreeBuilder& builder, int threads) {
    Device device;
    const auto warm_up = [&] {
        device = new_device(threads);
        build_embree(device, sample_of(mesh).soup(), builder);
    };
    return memory_in_child(builder.name, threads, warm_up, [&] { return build_embree(device, mesh.soup(), builder); });
}

}  // namespace

Json compare_memory(const Mesh& mesh, int threads) {
    Json rows;
    for (const Mode& mode : kModes) {
        rows.push_back(memory_of_ours(mesh, mode, threads));
    }
    for (const EmbreeBuilder& builder : kEmbreeBuilders) {
        rows.push_back(memory_of_embree(mesh, builder, threads));
    }
    return rows;
}

Json compare_large(const Mesh& mesh, int copy_count, int threads, double seconds) {
    const Mesh copies = copies_of(mesh, copy_count);
    const Mode& mode = kModes[kDefaultMode];
    const Json memory{memory_of_ours(copies, mode, threads), memory_of_embree(copies, kMedium, threads)};

    const Device device = new_device(threads);
    warm_up(mesh, device, threads);
    std::vector<OurBuilds> ours{{mesh.soup(), mode, threads}, {copies.soup(), mode, threads}};
    std::vector<Contestant> contestants;
    contestants.emplace_back(mode.name, threads, [&] { return ours[0].run(); });
    contestants.emplace_back(std::string(mode.name) + ", copies", threads, [&] { return ours[1].run(); });
    contestants.emplace_back(kMedium.name, threads, [&] { return time_embree(device, mesh.soup(), kMedium); });
    contestants.emplace_back(std::string(kMedium.name) + ", copies", threads,
                             [&] { return time_embree(device, copies.soup(), kMedium); });
    take_turns(contestants, seconds);
    return {{"copies", copy_count},
            {"triangles", copies.soup().size()},
            {"memory", memory},
            {"rows", rows_of(contestants)}};
}

Json compare_builds(const Mesh& mesh, int threads, double seconds) {
    const TriangleSoup soup = mesh.soup();
    const Device device = new_device(threads);
    warm_up(mesh, device, threads);

    std::vector<OurBuilds> ours;
    std::vector<Contestant> contestants;
    ours.reserve(2 * kModes.size());
    // The serial builder takes part whatever the number of threads: efficiency is a ratio of one run.
    for (const int count : threads == 1 ? std::vector{1} : std::vector{1, threads}) {
        for (const Mode& mode : kModes) {
            OurBuilds& builds = ours.emplace_back(soup, mode, count);
            contestants.emplace_back(mode.name, count, [&builds] { return builds.run(); });
        }
    }
    for (const EmbreeBuilder& builder : kEmbreeBuilders) {
        contestants.emplace_back(builder.name, threads, [&] { return time_embree(device, soup, builder); });
    }
    take_turns(contestants, seconds);

    Json rows = rows_of(contestants);
    for (size_t i = 0; i < ours.size(); ++i) {
        rows[i]["phases_ms"] = ours[i].phases_ms();
    }
    return {{"threads", threads}, {"rows", rows}};
}

Json compare_quality(const Mesh& mesh) {
    Json all;
    for (const Mode& mode : kModes) {
        all[mode.name] = quality_of(build(mesh.soup(), {.quality = mode.quality}));
    }
    return all;
}

}  // namespace espalier::bench
