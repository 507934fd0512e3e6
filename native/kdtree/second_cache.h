// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstddef>

namespace espalier {

/// Bytes of a core's second cache; 1 MiB where the system does not tell.
size_t second_cache_bytes();

}  // namespace espalier
