// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstddef>

namespace espalier {

/// Bytes of a core's L2 cache, of whichever core answers where they differ; 1 MiB where the system does not tell.
size_t l2_cache_bytes();

}  // namespace espalier
