// SPDX-License-Identifier: GPL-3.0-or-later
// The exact judge again, in integers and on many threads, for millions of rays (tests/fast_judge.py loads it). It
// shares nothing with the native code; tests/test_judge.py holds it against tests/judge.py and cases solved by hand.
//
// Every float is an integer multiple of 2^-149. With p0, p1, p2 the corners seen from the origin and d the direction,
// all in that unit, w0 = d (p1 x p2) and so on are the corners' weights: the line passes through the closed triangle if
// none has the other sign than their sum, which is zero for a line in the plane. From d [p0 p1 p2] = sum of w_k p_k
// follows t = [p0 p1 p2] / (w0 + w1 + w2), u = w1 / (...), v = w2 / (...).
#include <gmp.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <thread>
#include <vector>

namespace {

constexpr int kUnit = 149;               // the exponent of the smallest float
constexpr float kLargest = 0x1p60F;      // faces beyond are set aside, by convention
constexpr double kDoubt = 64 * 0x1p-53;  // see measure_faces

class Integer {
 public:
    Integer() { mpz_init2(value_, 1024); }
    explicit Integer(float x) : Integer() { mpz_set_d(value_, std::ldexp(static_cast<double>(x), kUnit)); }
    Integer(const Integer& other) { mpz_init_set(value_, other.value_); }
    Integer& operator=(const Integer& other) {
        mpz_set(value_, other.value_);
        return *this;
    }
    ~Integer() { mpz_clear(value_); }
    mpz_ptr get() { return value_; }
    mpz_srcptr get() const { return value_; }
    int sign() const { return mpz_sgn(value_); }

 private:
    mpz_t value_;
};

struct Point {
    Integer x[3];
};

Point exact_point(const float* p) { return {Integer(p[0]), Integer(p[1]), Integer(p[2])}; }

void subtract(Point& out, const Point& a, const Point& b) {
    for (int i = 0; i < 3; ++i) {
        mpz_sub(out.x[i].get(), a.x[i].get(), b.x[i].get());
    }
}

void cross(Point& out, const Point& a, const Point& b) {
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        const int k = (i + 2) % 3;
        mpz_mul(out.x[i].get(), a.x[j].get(), b.x[k].get());
        mpz_submul(out.x[i].get(), a.x[k].get(), b.x[j].get());
    }
}

void dot(Integer& out, const Point& a, const Point& b) {
    mpz_mul(out.get(), a.x[0].get(), b.x[0].get());
    mpz_addmul(out.get(), a.x[1].get(), b.x[1].get());
    mpz_addmul(out.get(), a.x[2].get(), b.x[2].get());
}

/// above / below in double, cut off: less than 2^-62 of it is lost, and then what a double cannot hold.
double quotient(const Integer& above, const Integer& below) {
    if (above.sign() == 0) {
        return 0;
    }
    const auto bits = [](const Integer& i) { return static_cast<long>(mpz_sizeinbase(i.get(), 2)); };
    const long shift = std::max(0L, bits(below) - bits(above) + 64);
    Integer q;
    mpz_mul_2exp(q.get(), above.get(), static_cast<mp_bitcnt_t>(shift));
    mpz_tdiv_q(q.get(), q.get(), below.get());
    long exponent = 0;
    const double mantissa = mpz_get_d_2exp(&exponent, q.get());
    return std::ldexp(mantissa, static_cast<int>(exponent - shift));
}

/// A hit on the line; below > 0.
struct Crossing {
    Integer above, below, w1, w2;
};

/// What one thread needs to decide one triangle.
struct Scratch {
    Point p[3];
    Point c[3];
    Integer w[3];
};

bool cross_triangle(const Point& origin, const Point& direction, const Point* const (&corners)[3], Scratch& s,
                    Crossing& out) {
    for (int k = 0; k < 3; ++k) {
        subtract(s.p[k], *corners[k], origin);
    }
    bool positive = false;
    bool negative = false;
    for (int k = 0; k < 3; ++k) {
        cross(s.c[k], s.p[(k + 1) % 3], s.p[(k + 2) % 3]);
        dot(s.w[k], direction, s.c[k]);
        positive |= s.w[k].sign() > 0;
        negative |= s.w[k].sign() < 0;
    }
    if (positive == negative) {  // on both sides, or all zero: in the plane
        return false;
    }
    mpz_add(out.below.get(), s.w[0].get(), s.w[1].get());
    mpz_add(out.below.get(), out.below.get(), s.w[2].get());
    dot(out.above, s.p[0], s.c[0]);
    out.w1 = s.w[1];
    out.w2 = s.w[2];
    if (negative) {
        for (Integer* i : {&out.below, &out.above, &out.w1, &out.w2}) {
            mpz_neg(i->get(), i->get());
        }
    }
    return true;
}

/// The sign of above / below - t.
int compare(const Crossing& crossing, float t, Scratch& s) {
    if (std::isinf(t)) {
        return -1;
    }
    mpz_mul_2exp(s.w[0].get(), crossing.above.get(), kUnit);
    mpz_mul(s.w[1].get(), Integer(t).get(), crossing.below.get());
    return mpz_cmp(s.w[0].get(), s.w[1].get());
}

int compare(const Crossing& a, const Crossing& b, Scratch& s) {
    mpz_mul(s.w[0].get(), a.above.get(), b.below.get());
    mpz_mul(s.w[1].get(), b.above.get(), a.below.get());
    return mpz_cmp(s.w[0].get(), s.w[1].get());
}

bool has_area(const std::vector<Point>& points, const int32_t* corner) {
    Point edges[2];
    for (int k = 0; k < 2; ++k) {
        subtract(edges[k], points[static_cast<size_t>(corner[k + 1])], points[static_cast<size_t>(corner[0])]);
    }
    Point normal;
    cross(normal, edges[0], edges[1]);
    return normal.x[0].sign() != 0 || normal.x[1].sign() != 0 || normal.x[2].sign() != 0;
}

/// The faces that can be hit, in rising order of their index.
struct Scene {
    std::vector<Point> points;          // of sound vertices; zero for others
    std::vector<int32_t> face;          // its index in the mesh
    std::vector<double> corners[3][3];  // [corner][axis], for the candidates
    const int32_t* triangles;
};

Scene make_scene(const float* vertices, size_t vertex_count, const int32_t* triangles, size_t triangle_count) {
    const auto is_sound = [&](int64_t v) {
        return std::all_of(vertices + 3 * v, vertices + 3 * v + 3, [](float x) { return std::abs(x) <= kLargest; });
    };
    Scene scene{{}, {}, {}, triangles};
    const float zero[3] = {};
    for (size_t v = 0; v < vertex_count; ++v) {
        scene.points.push_back(exact_point(is_sound(static_cast<int64_t>(v)) ? vertices + 3 * v : zero));
    }
    for (size_t i = 0; i < triangle_count; ++i) {
        const int32_t* t = triangles + 3 * i;
        if (!is_sound(t[0]) || !is_sound(t[1]) || !is_sound(t[2]) || !has_area(scene.points, t)) {
            continue;
        }
        scene.face.push_back(static_cast<int32_t>(i));
        for (int corner = 0; corner < 3; ++corner) {
            for (int axis = 0; axis < 3; ++axis) {
                scene.corners[corner][axis].push_back(vertices[3 * int64_t{t[corner]} + axis]);
            }
        }
    }
    return scene;
}

/// Per face, not negative if the line may meet it: its three weights, in double, are not surely of both signs. Each of
/// the six products in a weight carries two differences, two products and three sums, each with a relative error of
/// 2^-53; 64 of them are allowed. Nothing over- or underflows: all factors are multiples of 2^-149 below 2^128.
#if defined(__x86_64__)
__attribute__((target_clones("avx512f", "avx2", "default")))
#endif
void measure_faces(const Scene& scene, const float* o, const float* d, double* slack) {
    const double* in[3][3];
    for (int k = 0; k < 3; ++k) {
        for (int axis = 0; axis < 3; ++axis) {
            in[k][axis] = scene.corners[k][axis].data();
        }
    }
    const double ox = o[0], oy = o[1], oz = o[2];
    const double dx = d[0], dy = d[1], dz = d[2];
    for (size_t i = 0; i < scene.face.size(); ++i) {
        const double x[3] = {in[0][0][i] - ox, in[1][0][i] - ox, in[2][0][i] - ox};
        const double y[3] = {in[0][1][i] - oy, in[1][1][i] - oy, in[2][1][i] - oy};
        const double z[3] = {in[0][2][i] - oz, in[1][2][i] - oz, in[2][2][i] - oz};
        double least = std::numeric_limits<double>::max();  // of what the weights may be at most
        double most = std::numeric_limits<double>::max();   // likewise of their negatives
        for (int k = 0; k < 3; ++k) {
            const int l = (k + 1) % 3;
            const double yz = y[k] * z[l], zy = z[k] * y[l];
            const double zx = z[k] * x[l], xz = x[k] * z[l];
            const double xy = x[k] * y[l], yx = y[k] * x[l];
            const double weight = dx * (yz - zy) + dy * (zx - xz) + dz * (xy - yx);
            const double doubt =
                kDoubt * (std::abs(dx) * (std::abs(yz) + std::abs(zy)) + std::abs(dy) * (std::abs(zx) + std::abs(xz)) +
                          std::abs(dz) * (std::abs(xy) + std::abs(yx)));
            least = std::min(least, doubt + weight);
            most = std::min(most, doubt - weight);
        }
        slack[i] = std::max(least, most);
    }
}

struct Verdict {
    int32_t triangle;
    double t, u, v;
};

/// The nearest hit within [t_min, t_max], of equal ones the lowest index.
Verdict judge_ray(const Scene& scene, const float* o, const float* d, float t_min, float t_max, double* slack,
                  Scratch& scratch) {
    measure_faces(scene, o, d, slack);
    const Point origin = exact_point(o);
    const Point direction = exact_point(d);
    Crossing best;
    Crossing found;
    int32_t triangle = -1;
    for (size_t i = 0; i < scene.face.size(); ++i) {
        if (slack[i] < 0) {
            continue;
        }
        const int32_t* t = scene.triangles + 3 * int64_t{scene.face[i]};
        const Point* const corners[3] = {&scene.points[static_cast<size_t>(t[0])],
                                         &scene.points[static_cast<size_t>(t[1])],
                                         &scene.points[static_cast<size_t>(t[2])]};
        if (cross_triangle(origin, direction, corners, scratch, found) && compare(found, t_min, scratch) >= 0 &&
            compare(found, t_max, scratch) <= 0 && (triangle < 0 || compare(found, best, scratch) < 0)) {
            best = found;
            triangle = scene.face[i];
        }
    }
    if (triangle < 0) {
        return {-1, 0, 0, 0};
    }
    return {triangle, quotient(best.above, best.below), quotient(best.w1, best.below), quotient(best.w2, best.below)};
}

}  // namespace

extern "C" __attribute__((visibility("default"))) void espalier_judge(const float* vertices, size_t vertex_count,
                                                                      const int32_t* triangles, size_t triangle_count,
                                                                      const float* origins, const float* directions,
                                                                      const float* t_min, const float* t_max,
                                                                      size_t rays, int threads, int32_t* triangle,
                                                                      double* t, double* u, double* v) {
    const Scene scene = make_scene(vertices, vertex_count, triangles, triangle_count);
    std::atomic<size_t> next{0};
    const auto work = [&] {
        constexpr size_t kRun = 64;
        std::vector<double> slack(scene.face.size());
        Scratch scratch;
        for (size_t begin; (begin = next.fetch_add(kRun)) < rays;) {
            for (size_t i = begin; i < std::min(begin + kRun, rays); ++i) {
                const Verdict verdict =
                    judge_ray(scene, origins + 3 * i, directions + 3 * i, t_min[i], t_max[i], slack.data(), scratch);
                triangle[i] = verdict.triangle;
                t[i] = verdict.t;
                u[i] = verdict.u;
                v[i] = verdict.v;
            }
        }
    };
    std::vector<std::thread> others;
    for (int i = 1; i < threads; ++i) {
        others.emplace_back(work);
    }
    work();
    for (std::thread& thread : others) {
        thread.join();
    }
}
