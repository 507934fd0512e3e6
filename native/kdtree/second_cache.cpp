// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/second_cache.h"

#include <unistd.h>

namespace espalier {
namespace {

size_t ask_the_system() {
#ifdef _SC_LEVEL2_CACHE_SIZE
    if (const long bytes = sysconf(_SC_LEVEL2_CACHE_SIZE); bytes > 0) {
        return static_cast<size_t>(bytes);
    }
#endif
    return size_t{1} << 20;
}

}  // namespace

size_t second_cache_bytes() {
    // Asked once: where the processor is a virtual one, its host answers, which takes microseconds.
    static const size_t bytes = ask_the_system();
    return bytes;
}

}  // namespace espalier
