// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

namespace espalier {

/// While it lives, this thread rounds to nearest and keeps subnormal numbers; the caller's settings come back
/// afterwards. Hosts such as Blender run threads that flush subnormals to zero, and then x != y no longer implies x - y
/// != 0.
class FloatEnvironment {
 public:
    FloatEnvironment() : saved_(read()) { write(kDefault); }
    ~FloatEnvironment() { write(saved_); }
    FloatEnvironment(const FloatEnvironment&) = delete;
    FloatEnvironment& operator=(const FloatEnvironment&) = delete;

 private:
#if defined(__x86_64__)
    using Register = uint32_t;
    static constexpr Register kDefault = 0x1f80;  // all exceptions masked, round to nearest, no FTZ, no DAZ
    static Register read() { return _mm_getcsr(); }
    static void write(Register value) { _mm_setcsr(value); }
#elif defined(__aarch64__)
    using Register = uint64_t;
    static constexpr Register kDefault = 0;
    static Register read() {
        Register value;
        asm volatile("mrs %0, fpcr" : "=r"(value));
        return value;
    }
    static void write(Register value) { asm volatile("msr fpcr, %0" : : "r"(value) : "memory"); }
#else
#error "Say here how this processor's rounding and subnormal modes are set"
#endif
    Register saved_;
};

}  // namespace espalier
