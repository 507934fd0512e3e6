// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/l2_cache.h"

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

size_t l2_cache_bytes() {
    // Asked once, since some C libraries ask the processor each time, which in a virtual machine takes microseconds.
    static const size_t bytes = ask_the_system();
    return bytes;
}

}  // namespace espalier
