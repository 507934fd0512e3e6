// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

/// The docstrings of the Python module: shapes, dtypes, units, frames and errors.
namespace espalier::docs {

inline constexpr const char* kModule =
    R"(Ray casting with kd-trees that are built on every core. NumPy in, NumPy out; no Blender needed.

build() makes a Tree over triangles, to be asked for hits. Scene, render(), start_preview() and
start_compare() draw placed meshes with a camera and lights, and time the building.)";

inline constexpr const char* kSimdTargets =
    R"(The instruction sets this machine can run: the one in use, then the others, best first.

The best is used, unless the environment variable ESPALIER_SIMD names another before the first call.)";

inline constexpr const char* kHardwareThreads =
    "How many threads this process may run at the same time: what threads=0 stands for.";

inline constexpr const char* kBuild = R"(Builds a kd-tree over triangles.

vertices: float32 [N, 3], any values. triangles: int32 or uint32 [M, 3], indices into vertices.
quality: 'draft', 'balanced' or 'best': how long to look for good splits, never what a ray hits.
'exact' tries them all, for comparison with the others.
threads: 0 for all; the tree is the same, bit for bit, for any number.
Faces that are not finite, have no area or lie beyond 2^60 are counted in the report and left out.
Raises TypeError for another dtype, ValueError for another shape, quality or number of threads,
IndexError for an index out of range.)";

inline constexpr const char* kTree =
    "A kd-tree over triangles, made by build(). It keeps its own copy of them and never changes.";

inline constexpr const char* kReport = R"(What the build took and what came of it, a dict.

build_ms and phases_ms {bounds, top_levels, subtrees, compaction, layout}: wall-clock milliseconds.
threads; triangles (as given); nodes; leaves; empty_leaves; references (of leaves to triangles);
wide_nodes; bytes. sah_cost: expected cost of a ray that meets the scene's box, in the units of
sah_constants, which are the same for every quality. subtrees, opened: 0, but for a picture drawn on
demand. checksum: 16 hexadecimal digits, the same for any number of threads.
rejected_faces {not_finite, no_area, too_large}: faces that no ray can hit, left out of the tree.)";

inline constexpr const char* kIntersect =
    R"(The nearest hit of each ray with t_min <= t <= t_max, of equal distances the lowest triangle.

origins, directions: float32 [R, 3]. Directions need not have unit length, t counts in them; their
largest component lies between 2^-100 and 2^100.
t_min, t_max: a number, or float32 [R] with one per ray. threads: 0 for all.
Returns t float32 [R] (inf at a miss), triangle int32 [R] (-1 at a miss), u and v float32 [R]
(0 at a miss): the point is (1-u-v) v0 + u v1 + v v2.
Raises TypeError for another dtype, ValueError for another shape, a ray that is not finite, a zero
direction, a negative t_min or t_max < t_min.)";

inline constexpr const char* kOccluded = R"(Whether each ray hits anything with t_min <= t <= t_max: bool [R].

Arguments and errors as of intersect().)";

inline constexpr const char* kArrays = R"(Copies of the tree's own arrays, for comparing trees.

nodes: uint64 [K], depth first. wide_nodes: uint8 [W, 256]. blocks: uint8 [B, 320], eight triangles each.)";

inline constexpr const char* kScene = R"(Placed meshes, flattened to world triangles.

Positions are formed in double relative to the scene's centre and rounded once. Immutable; it copies
what it needs, so the arrays may change or go afterwards.)";

inline constexpr const char* kSceneInit = R"(Places the meshes.

meshes: dicts with name: str, positions: float32 [N, 3], triangles: int32 or uint32 [M, 3],
normals: None (flat), float32 [N, 3] (per vertex) or float32 [M, 3, 3] (per corner), in object space,
material_slots: None or int32 [M], the slot of each triangle.
placements: dicts with object: str, mesh: index into meshes, matrix: float64 [4, 4], object to world
(negative scale allowed), materials: int32 [S], at least one: the material of each slot; a slot
beyond takes the last. materials: float32 [K, 3], linear base colours.
Raises TypeError, ValueError or IndexError naming the mesh or the object.)";

inline constexpr const char* kTriangleCount = "World triangles, rejected faces included.";

inline constexpr const char* kCentre =
    "The middle of the world bounds, float64 [3]: the point that world triangles are relative to.";

inline constexpr const char* kObjects =
    R"(One dict per object name: object, triangles, rejected_faces {not_finite, no_area, too_large}.

lost_precision: empty where nothing was lost to float's rounding, else the precision (see `precision`)
of a typical edge by cause. mesh: of the coordinates the mesh was given with. placement: of the
matrix's translation, where that is a float. scene: of the world triangles. The first and the last are
lost when an ulp is more than 1/64 of the median edge, a placement when it is more than 1/8 of it.)";

inline constexpr const char* kPrecision =
    R"(How fine float32 is at the rim of the scene, against how fine the scene is: a dict.

distance_m: the largest coordinate of a world triangle, relative to the centre. ulp_m: how far apart
neighbouring floats are there. median_edge_m, and ulp_per_median_edge: over an even sample of faces.)";

inline constexpr const char* kSceneArrays = R"(Copies of the world triangles, relative to the centre.

vertices: float32 [N, 3]. triangles: uint32 [M, 3]. first_triangles: uint32, the first triangle of each
placement, then M.)";

inline constexpr const char* kSurface = R"(The points of the scene that rays hit.

triangle: int32 [R], -1 at a miss, u and v: float32 [R], as Tree.intersect() returns them for a tree over
arrays(). directions: float32 [R, 3], those of the rays.
Returns placement int32 [R] (-1 at a miss), position float64 [R, 3] relative to the centre, and
geometric_normal and shading_normal float64 [R, 3], of unit length, turned against the ray (0 at a miss).
Raises TypeError, ValueError, or IndexError for a triangle that is not in the scene.)";

inline constexpr const char* kStartPreview =
    "Starts building a scene's tree and drawing its picture, and returns the Job at once.\n\n"
    "Arguments, result and errors as of render().";

inline constexpr const char* kRender = R"(Builds a scene's tree, draws its picture and returns the result.

camera: dict with type 'PERSP' or 'ORTHO', matrix_world: float64 [4, 4], projection: float64 [4, 4]
in OpenGL's convention; its clip range holds.
lights: dicts with type 'POINT', 'SUN', 'SPOT' or 'AREA', matrix: float64 [4, 4] (it shines along
its -Z), color: linear RGB, energy: W (sun: W/m2), shadow: bool; point and spot: radius in m; sun:
angle in rad; spot: spot_size in rad, spot_blend 0..1; area: shape 'SQUARE', 'RECTANGLE', 'DISK' or
'ELLIPSE', size and size_y in m. Their units and falloffs are those of Cycles.
world_color: linear RGB of the background; it lights the scene too. Without lights a soft sky does.
width, height: pixels. quality: of the tree. samples: rays per pixel. threads: 0 for all; the image
is the same, bit for bit, for any number. on_demand: in scenes of two million triangles and more,
subtrees are built when the first ray enters them; the image is the same, and `build` then has no
sizes and no cost of the tree, but how many subtrees waited and how many were opened.
Returns a dict. image: float32 [H, W, 4] linear RGBA, bottom row first. build: as Tree.report.
trace: trace_ms, threads, samples, primary_rays, shadow_rays, mrays_per_s. placing_ms.
objects: as Scene.objects.
Raises TypeError or ValueError naming the argument.)";

inline constexpr const char* kStartCompare =
    R"(Starts timing the build of a scene's tree, serial and with each number of threads.

Repeats are interleaved: all numbers once, then all again. thread_counts: positive, none twice.
repeats: builds per row, of which medians are taken.
The Job's result is a dict. triangles. serial: a row. threads: one row per number, in order.
A row is as Tree.report with medians for its times, and build_ms_min, build_ms_max, repeats,
speed_up (over serial), efficiency (speed_up per thread), mtri_per_s, references_per_triangle.
Raises TypeError or ValueError naming the argument.)";

inline constexpr const char* kCancelled = "Raised by Job.result() of a job that was cancelled.";

inline constexpr const char* kJob =
    "Work that a native thread does in the background. Dropping the last reference cancels it.";

inline constexpr const char* kProgress = "From 0 to 1, never falling.";

inline constexpr const char* kStage = "'placing', 'building', 'tracing', 'comparing', 'done', 'cancelled' or 'failed'.";

inline constexpr const char* kDone = "True once the job has ended, in whatever way.";

inline constexpr const char* kCancel = "Asks the job to stop. It ends soon after, and result() then raises Cancelled.";

inline constexpr const char* kWait =
    "Waits until the job has ended, for at most `timeout` seconds (None: for ever). Returns `done`.";

inline constexpr const char* kResult =
    "Waits for the job's end and returns its result. Raises Cancelled or the job's error.";

inline constexpr const char* kImage =
    R"(What a preview has finished so far, None before its first tile and for other jobs.

float32 [H, W, 4], linear RGBA, bottom row first, transparent black where nothing is yet.)";

}  // namespace espalier::docs
