// SPDX-License-Identifier: GPL-3.0-or-later
// What the measuring programs share: meshes, the modes that are measured, and contestants that take turns.
#pragma once

#include <malloc.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>
#include <numeric>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "kdtree/parallel.h"
#include "kdtree/tree.h"

namespace espalier::bench {

using Json = nlohmann::ordered_json;

struct Mode {
    const char* name;
    Quality quality;
};
inline constexpr std::array kModes{Mode{"draft", Quality::kDraft}, Mode{"balanced", Quality::kBalanced},
                                   Mode{"best", Quality::kBest}, Mode{"exact", Quality::kExact}};
constexpr size_t kDefaultMode = 1;

/// How a mesh is looked at: a square pinhole picture and one point light.
struct View {
    Vec3f eye, target, up, light;
    float slope;  ///< half the picture's width at distance 1
};

struct Mesh {
    std::vector<float> positions;  ///< one more than belong to vertices: Embree reads 16 bytes of each
    std::vector<uint32_t> triangles;
    View view;

    TriangleSoup soup() const { return {std::span(positions).first(positions.size() - 1), triangles}; }
};

/// Reads what run.py writes: two 64-bit counts, the view, positions and indices.
inline Mesh read_mesh(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    const auto read = [&](void* to, size_t bytes) {
        if (!file.read(static_cast<char*>(to), static_cast<std::streamsize>(bytes))) {
            throw std::runtime_error(path + " cannot be read, or is shorter than its counts say");
        }
    };
    Mesh mesh;
    uint64_t counts[2];
    read(counts, sizeof counts);
    read(&mesh.view, sizeof mesh.view);
    mesh.positions.resize(3 * counts[0] + 1);
    mesh.triangles.resize(3 * counts[1]);
    read(mesh.positions.data(), 3 * counts[0] * sizeof(float));
    read(mesh.triangles.data(), 3 * counts[1] * sizeof(uint32_t));
    return mesh;
}

/// So many copies of a mesh, side by side on a square.
inline Mesh copies_of(const Mesh& mesh, int copies) {
    Box3f bounds;
    const size_t vertices = mesh.positions.size() / 3;
    for (size_t i = 0; i < vertices; ++i) {
        bounds.extend(Vec3f{mesh.positions[3 * i], mesh.positions[3 * i + 1], mesh.positions[3 * i + 2]});
    }
    const auto across = static_cast<int>(std::ceil(std::sqrt(copies)));
    Mesh all{{}, {}, mesh.view};
    all.positions.reserve(3 * vertices * static_cast<size_t>(copies) + 1);
    all.triangles.reserve(mesh.triangles.size() * static_cast<size_t>(copies));
    for (int copy = 0; copy < copies; ++copy) {
        const int row = copy / across;
        const float shift[3] = {bounds.size().x * static_cast<float>(copy - row * across),
                                bounds.size().y * static_cast<float>(row), 0};
        for (size_t i = 0; i < 3 * vertices; ++i) {
            all.positions.push_back(mesh.positions[i] + shift[i % 3]);
        }
        for (const uint32_t index : mesh.triangles) {
            all.triangles.push_back(index + static_cast<uint32_t>(vertices) * static_cast<uint32_t>(copy));
        }
    }
    all.positions.push_back(0);
    return all;
}

/// The first triangles of a mesh: enough to load code and wake threads before a clock runs.
inline Mesh sample_of(const Mesh& mesh) {
    Mesh sample = mesh;
    sample.triangles.resize(std::min<size_t>(mesh.triangles.size(), 3000));
    return sample;
}

/// Large blocks come from the system every time, as in a program's first build; by default glibc would begin to keep
/// those that were freed.
inline void use_fresh_memory() {
    mallopt(M_MMAP_THRESHOLD, 128 * 1024);
    mallopt(M_TRIM_THRESHOLD, 128 * 1024);
}

class Stopwatch {
 public:
    double ms() const {
        return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start_).count();
    }

 private:
    std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

/// Something that is timed again and again.
struct Contestant {
    Contestant(std::string n, int t, std::function<double()> r) : name(std::move(n)), threads(t), run(std::move(r)) {}

    std::string name;
    int threads;
    std::function<double()> run;  ///< once; returns milliseconds
    std::vector<double> ms;       ///< of each turn
};

/// Runs the contestants in turn until the time is spent, each at least five times. Every other turn goes backwards, A B
/// C C B A, so that none always comes after the one that leaves least in the caches. Those that are too slow to keep
/// pace drop out earlier: after one turn, or when a quarter of the time was theirs.
inline void take_turns(std::vector<Contestant>& contestants, double seconds) {
    constexpr int kLeast = 5;
    constexpr int kMost = 31;
    const double available = seconds * 1e3;
    const auto drops_out = [&](const Contestant& contestant) {
        const double spent = std::accumulate(contestant.ms.begin(), contestant.ms.end(), 0.0);
        return !contestant.ms.empty() &&
               (contestant.ms[0] > available / 2 || (contestant.ms.size() >= kLeast && spent > available / 4));
    };
    const Stopwatch watch;
    for (int turn = 0; turn < kMost && (turn < kLeast || watch.ms() < available); ++turn) {
        for (size_t i = 0; i < contestants.size(); ++i) {
            Contestant& contestant = contestants[turn % 2 == 0 ? i : contestants.size() - 1 - i];
            if (!drops_out(contestant)) {
                // Threads of the one before go to sleep first; they spin for a while.
                std::this_thread::sleep_for(std::chrono::milliseconds(2));
                contestant.ms.push_back(contestant.run());
            }
        }
    }
}

inline Json rows_of(const std::vector<Contestant>& contestants) {
    Json rows;
    for (const Contestant& contestant : contestants) {
        rows.push_back({{"name", contestant.name}, {"threads", contestant.threads}, {"ms", contestant.ms}});
    }
    return rows;
}

}  // namespace espalier::bench
