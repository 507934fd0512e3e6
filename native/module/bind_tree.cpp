// SPDX-License-Identifier: GPL-3.0-or-later
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <mutex>
#include <vector>

#include "geometry/float_environment.h"
#include "geometry/triangle.h"
#include "kdtree/parallel.h"
#include "kdtree/simd_config.h"
#include "kdtree/traversal.h"
#include "module/arrays.h"
#include "module/bindings.h"
#include "module/docs.h"
#include "module/reports.h"
// Highway's own header has to follow simd_config.h.
#include <hwy/highway.h>

namespace py = pybind11;
using namespace py::literals;

namespace espalier {
namespace {

namespace hn = hwy::HWY_NAMESPACE;

constexpr size_t kRaysPerTask = 4096;
/// What the largest component of a direction may be.
constexpr float kShortest = 0x1p-100F;
constexpr float kLongest = 0x1p100F;

/// One end of the rays' range: the same for all, or one number per ray.
struct RangeEnd {
    float shared = 0.0F;
    Array<float> each;
    const float* first = each.owner.size() > 0 ? each.owner.data() : nullptr;

    float operator[](size_t ray) const { return first != nullptr ? first[ray] : shared; }
};

RangeEnd range_end(py::handle value, const std::string& name, size_t rays) {
    if (py::isinstance<py::array>(value) && py::reinterpret_borrow<py::array>(value).ndim() > 0) {
        return {0.0F, float_array(value, name, {static_cast<py::ssize_t>(rays)})};
    }
    const double number = PyFloat_AsDouble(value.ptr());
    if (number == -1.0 && PyErr_Occurred() != nullptr) {
        PyErr_Clear();
        throw py::type_error(name + " must be a number or a float32 array with one number per ray");
    }
    return {static_cast<float>(number), {}};
}

/// Packs rays, each as two quadruples, and keeps whether all were sound.
class RayPacker {
    using D = hn::Full128<float>;
    using V = hn::Vec<D>;

 public:
    /// Reads four numbers of each of the two rows.
    void pack(const float* origin, float t_min, const float* direction, float t_max, Ray& ray) {
        const V from = hn::InsertLane(hn::LoadU(D(), origin), 3, t_min);
        const V along = hn::InsertLane(hn::LoadU(D(), direction), 3, t_max);
        hn::StoreU(from, D(), &ray.origin.x);
        hn::StoreU(along, D(), &ray.direction.x);
        const V size = hn::Abs(along);
        const V largest = hn::Max(size, hn::Max(hn::Shuffle0321(size), hn::Shuffle1032(size)));  // in the first lane
        // Comparisons with NaN are false.
        const auto is_near = hn::And(hn::Le(hn::Abs(from), farthest_), hn::Ge(from, least_));
        const auto is_usual = hn::And(hn::Le(size, longest_), hn::Ge(largest, shortest_));
        const auto is_range = hn::Ge(hn::IfThenElse(is_end_, along, from), from);
        sound_ = hn::And(sound_, hn::And(hn::And(is_near, is_usual), is_range));
    }
    bool all_sound() const { return hn::AllTrue(D(), sound_); }

 private:
    static V quad(float xyz, float end) { return hn::InsertLane(hn::Set(D(), xyz), 3, end); }

    static constexpr float kMost = std::numeric_limits<float>::max();
    const V farthest_ = quad(kMaxCoordinate, kMost);
    const V least_ = quad(-kMost, 0);
    const V longest_ = quad(kLongest, std::numeric_limits<float>::infinity());
    const V shortest_ = hn::InsertLane(hn::Zero(D()), 0, kShortest);
    const hn::Mask<D> is_end_ = hn::Gt(quad(0, 1), hn::Zero(D()));
    hn::Mask<D> sound_ = hn::Eq(hn::Zero(D()), hn::Zero(D()));
};

/// Rays as they came from Python, checked while they are packed.
class RayInput {
 public:
    RayInput(py::handle origins, py::handle directions, py::handle t_min, py::handle t_max, int threads)
        : origins_(float_array(origins, "origins", {kAny, 3})),
          directions_(float_array(directions, "directions", {kAny, 3})),
          t_min_(range_end(t_min, "t_min", origins_.rows())),
          t_max_(range_end(t_max, "t_max", origins_.rows())),
          runs_((size() + kRaysPerTask - 1) / kRaysPerTask) {
        if (directions_.rows() != origins_.rows()) {
            throw py::value_error("directions must have as many rows as origins (" + std::to_string(origins_.rows()) +
                                  "), not " + std::to_string(directions_.rows()));
        }
        const int wanted = checked_threads(threads) > 0 ? threads : hardware_threads();
        workers_ = std::min(static_cast<size_t>(wanted), runs_);
    }

    size_t size() const { return origins_.rows(); }
    /// How many rays come at once at most.
    size_t longest_run() const { return std::min(size(), kRaysPerTask); }
    /// How many threads there are and work for.
    size_t workers() const { return workers_; }

    /// Calls trace(first, rays, worker) for runs of rays, `worker` below workers(); throws for the first ray that is
    /// not sound.
    template <class Trace>
    void for_each_run(const Trace& trace) {
        const py::gil_scoped_release release;
        const FloatEnvironment environment;  // a subnormal number is one here, too
        std::vector<Ray> packed(workers_ * longest_run());
        std::mutex mutex;
        size_t first_bad = size();
        const char* what = nullptr;
        parallel_for(static_cast<int>(workers_), runs_, [&](size_t run, int worker) {
            const std::span<Ray> rays(&packed[static_cast<size_t>(worker) * longest_run()],
                                      std::min(kRaysPerTask, size() - run * kRaysPerTask));
            const size_t first = run * kRaysPerTask;
            const auto bad = pack(first, rays) ? rays.end() : std::find_if(rays.begin(), rays.end(), fault);
            if (bad == rays.end()) {
                trace(first, std::span<const Ray>(rays), worker);
                return;
            }
            const std::lock_guard lock(mutex);
            if (const size_t number = first + static_cast<size_t>(bad - rays.begin()); number < first_bad) {
                first_bad = number;
                what = fault(*bad);
            }
        });
        if (first_bad < size())
            throw py::value_error("ray " + std::to_string(first_bad) + ": " + what);
    }

 private:
    /// Whether all of them are sound.
    bool pack(size_t first, std::span<Ray> rays) const {
        const float* o = origins_.span().data() + 3 * first;
        const float* d = directions_.span().data() + 3 * first;
        RayPacker packer;
        // A row is read with what lies behind it. Behind the last lies nothing.
        const size_t followed = std::min(rays.size(), size() - 1 - first);
        for (size_t i = 0; i < followed; ++i, o += 3, d += 3) {
            packer.pack(o, t_min_[first + i], d, t_max_[first + i], rays[i]);
        }
        if (followed < rays.size()) {
            const float origin[4] = {o[0], o[1], o[2], 0};
            const float direction[4] = {d[0], d[1], d[2], 0};
            packer.pack(origin, t_min_[first + followed], direction, t_max_[first + followed], rays.back());
        }
        return packer.all_sound();
    }

    /// What is wrong with a ray; nullptr if it is sound.
    static const char* fault(const Ray& ray) {
        if (!is_finite(ray.origin))
            return "origins is not finite";
        if (largest_of(ray.origin) > kMaxCoordinate)
            return "origins must not lie beyond 2^60";
        if (!is_finite(ray.direction))
            return "directions is not finite";
        const float size = largest_of(ray.direction);
        if (size == 0.0F)
            return "directions is zero";
        if (size < kShortest || size > kLongest)
            return "directions must have its largest component between 2^-100 and 2^100";
        if (!(ray.t_min >= 0.0F) || std::isinf(ray.t_min))
            return "t_min must be finite and not negative";
        if (!(ray.t_max >= ray.t_min))
            return "t_max must not be less than t_min";
        return nullptr;
    }

    Array<float> origins_, directions_;
    RangeEnd t_min_, t_max_;
    size_t runs_;
    size_t workers_ = 0;
};

std::unique_ptr<Tree> build_tree(py::handle vertices, py::handle triangles, const std::string& quality, int threads) {
    const Array<float> positions = float_array(vertices, "vertices", {kAny, 3});
    const Array<uint32_t> indices = triangle_array(triangles, "triangles", positions.rows());
    const BuildOptions options{.quality = quality_from(quality), .threads = checked_threads(threads)};
    const py::gil_scoped_release release;
    return std::make_unique<Tree>(build({positions.span(), indices.span()}, options));
}

py::dict intersect_rays(const Tree& tree, py::handle origins, py::handle directions, py::handle t_min, py::handle t_max,
                        int threads) {
    RayInput input(origins, directions, t_min, t_max, threads);
    const auto count = static_cast<py::ssize_t>(input.size());
    py::array_t<float> t(count), u(count), v(count);
    py::array_t<int32_t> triangle(count);
    float *t_out = t.mutable_data(), *u_out = u.mutable_data(), *v_out = v.mutable_data();
    int32_t* triangle_out = triangle.mutable_data();
    std::vector<Hit> found(input.workers() * input.longest_run());
    input.for_each_run([&](size_t first, std::span<const Ray> rays, int worker) {
        const std::span<Hit> hits(&found[static_cast<size_t>(worker) * input.longest_run()], rays.size());
        intersect(tree, rays, hits);
        for (size_t i = 0; i < hits.size(); ++i) {
            const Hit& hit = hits[i];
            t_out[first + i] = hit.triangle < 0 ? std::numeric_limits<float>::infinity() : hit.t;
            u_out[first + i] = hit.u;
            v_out[first + i] = hit.v;
            triangle_out[first + i] = hit.triangle;
        }
    });
    return py::dict("t"_a = t, "triangle"_a = triangle, "u"_a = u, "v"_a = v);
}

py::array_t<bool> occluded_rays(const Tree& tree, py::handle origins, py::handle directions, py::handle t_min,
                                py::handle t_max, int threads) {
    RayInput input(origins, directions, t_min, t_max, threads);
    py::array_t<bool> blocked(static_cast<py::ssize_t>(input.size()));
    static_assert(sizeof(bool) == sizeof(uint8_t));
    auto* out = reinterpret_cast<uint8_t*>(blocked.mutable_data());
    input.for_each_run([&](size_t first, std::span<const Ray> rays, int) {
        occluded(tree, rays, std::span<uint8_t>(out + first, rays.size()));
    });
    return blocked;
}

/// The bytes of a buffer as rows of one element type, copied.
template <class Element, class T>
py::array bytes_array(const LargeBuffer<T>& buffer, size_t count, std::vector<py::ssize_t> shape) {
    static_assert(sizeof(T) % sizeof(Element) == 0);
    shape.insert(shape.begin(), static_cast<py::ssize_t>(count));
    py::array_t<Element> array(shape);
    if (count > 0)
        std::memcpy(array.mutable_data(), buffer.data(), count * sizeof(T));
    return array;
}

py::dict tree_arrays(const Tree& tree) {
    return py::dict("nodes"_a = bytes_array<uint64_t>(tree.nodes, tree.nodes.size(), {}),
                    "wide_nodes"_a = bytes_array<uint8_t>(tree.wide_nodes, tree.wide_nodes.size(), {sizeof(WideNode)}),
                    "blocks"_a = bytes_array<uint8_t>(tree.blocks, tree.blocks.size(), {sizeof(TriangleBlock)}));
}

}  // namespace

void bind_tree(py::module_& module) {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    py::class_<Tree>(module, "Tree", docs::kTree)
        .def_property_readonly(
            "report", [](const Tree& tree) { return report_dict(tree.report); }, docs::kReport)
        .def("intersect", &intersect_rays, "origins"_a, "directions"_a, "t_min"_a = 0.0, "t_max"_a = kInfinity,
             "threads"_a = 0, docs::kIntersect)
        .def("occluded", &occluded_rays, "origins"_a, "directions"_a, "t_min"_a = 0.0, "t_max"_a = kInfinity,
             "threads"_a = 0, docs::kOccluded)
        .def("arrays", &tree_arrays, docs::kArrays);
    module.def("build", &build_tree, "vertices"_a, "triangles"_a, "quality"_a = "balanced", "threads"_a = 0,
               docs::kBuild);
}

}  // namespace espalier
