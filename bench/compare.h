// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "bench.h"
#include "embree.h"

namespace espalier::bench {

/// Resident megabytes over the input per builder, each in a child process. Call it before any thread is started.
Json compare_memory(const Mesh& mesh, int threads);

/// Builds of the mesh and of so many copies of it, in turns, with the memory that the copies take. Call it before any
/// thread is started.
Json compare_large(const Mesh& mesh, int copies, int threads, double seconds);

/// Milliseconds per builder, ours also with the serial builder, in turns for about so many seconds.
Json compare_builds(const Mesh& mesh, int threads, double seconds);

/// What the trees of our modes cost in two surface-area models, and their sizes.
Json compare_quality(const Mesh& mesh);

/// Milliseconds per set of rays: on the trees of our modes, the default one also with a single thread, and for Embree's
/// calls; steps per ray, and the rays where the faces differ.
Json compare_rays(const Mesh& mesh, int threads, double seconds);

/// Milliseconds from triangles in memory to a picture with one light and its shadows.
Json compare_previews(const Mesh& mesh, int threads, double seconds);

}  // namespace espalier::bench
