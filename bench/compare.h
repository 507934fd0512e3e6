// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "bench.h"
#include "embree.h"

namespace espalier::bench {

/// Resident megabytes over the input per builder, each in a child process. Call it before any thread is started.
Json compare_memory(const Mesh& mesh, int threads);

/// Milliseconds per builder, ours also with the serial builder, in turns for about so many seconds.
Json compare_builds(const Mesh& mesh, int threads, double seconds);

/// What the trees of our modes cost in two surface-area models, and their sizes.
Json compare_quality(const Mesh& mesh);

}  // namespace espalier::bench
