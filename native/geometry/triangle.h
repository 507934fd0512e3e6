// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

#include "geometry/vec.h"

namespace espalier {

/// Why a face is set aside before the tree is built. None of these can ever be hit.
enum class FaceFault : uint8_t {
    kNone,
    kNotFinite,  ///< a coordinate is NaN or infinite
    kTooLarge,   ///< a coordinate lies beyond kMaxCoordinate
    kNoArea,     ///< the three corners lie on one line, decided exactly
};

/// Beyond this, products of coordinates could overflow float (four factors in the shear of the triangle test).
constexpr float kMaxCoordinate = 0x1p60F;

/// Decides exactly, for the float coordinates as they are, whether a face can be hit at all.
FaceFault classify_face(Vec3f v0, Vec3f v1, Vec3f v2);

}  // namespace espalier
