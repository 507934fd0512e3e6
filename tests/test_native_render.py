# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures: cameras, lights in Cycles' units, shading and shadows, with NumPy alone."""

from __future__ import annotations

from typing import Any

import espalier_native
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.native_kit import (
    Doubles,
    Floats,
    box_view,
    bumpy_sheet,
    camera,
    frustum,
    light,
    looking,
    mesh,
    moved,
    output_of,
    placed,
    rotation,
    scene,
    sphere,
)

QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
FLOOR = mesh(np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]]), QUAD)
FROM_ABOVE = camera(moved(0, 0, 10), box_view(-4, 4, -4, 4))
BACKGROUND = (7.0, 8.0, 9.0)
BLACK = (0.0, 0.0, 0.0)


def draw(
    what: espalier_native.Scene,
    view: dict[str, Any],
    lights: list[dict[str, Any]] | None = None,
    size: tuple[int, int] = (32, 32),
    world: tuple[float, float, float] = BLACK,
    **settings: Any,
) -> Floats:
    image = espalier_native.render(what, view, lights or [], world, *size, **settings)["image"]
    assert image.dtype == np.float32
    assert image.shape == (size[1], size[0], 4)
    assert np.all(np.isfinite(image))
    assert np.all(image[..., 3] == 1)
    return np.asarray(image)


def covered(image: Floats) -> NDArray[np.bool_]:
    return np.asarray(np.any(image[..., :3] != BACKGROUND, axis=-1))


def window_corners(view: dict[str, Any], x0: float, x1: float, y0: float, y1: float, depth: float) -> Doubles:
    """The world points that the view shows at the corners of a part (0..1) of the picture, at a depth."""
    corners = []
    for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1)):
        ends = [np.linalg.solve(view["projection"], [2 * x - 1, 2 * y - 1, z, 1]) for z in (-1, 1)]
        near, far = (end[:3] / end[3] for end in ends)
        point = near + (far - near) * (-depth - near[2]) / (far[2] - near[2])
        corners.append(view["matrix_world"] @ [*point, 1])
    return np.array(corners)[:, :3]


VIEWS = {
    "perspective": frustum(-0.4, 0.4, -0.3, 0.3),
    "shifted": frustum(-0.1, 0.7, 0.05, 0.65),
    "orthographic": box_view(-4, 4, -3, 3),
    "orthographic shifted": box_view(-1, 7, 0.5, 6.5, near=-50),
}


@pytest.mark.parametrize("projection", VIEWS)
def test_pixels_see_what_the_projection_says(projection: str) -> None:
    width, height = 40, 30
    for seed, (x0, x1, y0, y1) in enumerate([(3, 17, 4, 9), (20, 21, 29, 30), (0, 40, 15, 16)]):
        place = moved(1e5, -2e5, 3e4) @ rotation(seed)
        view = camera(place, VIEWS[projection])
        corners = window_corners(view, x0 / width, x1 / width, y0 / height, y1 / height, depth=20)
        # The mesh keeps small numbers, the placement carries it far away: as in Blender.
        local = np.linalg.solve(place, np.hstack([corners, np.ones((4, 1))]).T).T[:, :3]
        image = draw(
            scene([mesh(local, QUAD)], [placed(place)]), view, size=(width, height), world=BACKGROUND, samples=1
        )
        expected = np.zeros((height, width), bool)
        expected[y0:y1, x0:x1] = True
        np.testing.assert_array_equal(covered(image), expected)


def test_scale_of_the_camera_object_is_ignored() -> None:
    what = scene([mesh(*sphere())])
    view = camera(looking((3, 2, 1), (0, 0, 0)), VIEWS["shifted"])
    scaled = camera(view["matrix_world"] @ np.diag([2, 3, 0.5, 1]), VIEWS["shifted"])
    image = draw(what, view, size=(40, 30), world=BACKGROUND)
    assert 0 < np.count_nonzero(covered(image)) < 1200
    np.testing.assert_allclose(draw(what, scaled, size=(40, 30), world=BACKGROUND), image, atol=1e-5)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_clip_range_holds(projection: str) -> None:
    planes = {"perspective": frustum(-1, 1, -1, 1, 2, 6), "orthographic": box_view(-1, 1, -1, 1, 2, 6)}
    view = camera(np.eye(4), planes[projection])
    wall = mesh(np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]]), QUAD)
    for depth, seen in ((1.9, False), (2.1, True), (5.9, True), (6.1, False), (-3, False)):
        image = draw(scene([wall], [placed(moved(0, 0, -depth))]), view, world=BACKGROUND, samples=1)
        assert np.all(covered(image) == seen), depth


def test_picture_of_a_tree_opened_on_demand_is_the_same() -> None:
    ball = mesh(*sphere(60, 90))
    row = scene([ball], [placed(moved(3.0 * i, 0, 0)) for i in range(200)])
    assert row.triangle_count > 2_000_000
    view = camera(looking((0, -6, 1), (0, 0, 0)), VIEWS["perspective"])
    drawn = {
        on_demand: espalier_native.render(row, view, [], BACKGROUND, 48, 36, samples=2, on_demand=on_demand)
        for on_demand in (False, True)
    }
    assert 0 < np.count_nonzero(covered(drawn[False]["image"])) < 48 * 36
    np.testing.assert_array_equal(drawn[True]["image"], drawn[False]["image"])
    whole, part = drawn[False]["build"], drawn[True]["build"]
    assert (whole["subtrees"], whole["opened"]) == (0, 0)
    assert 0 < part["opened"] < part["subtrees"] / 2
    assert part["nodes"] == 0 < whole["nodes"]


def test_samples_cover_their_pixel_evenly() -> None:
    samples = 64
    half = mesh(np.array([[-9, -9, 0], [0.25, -9, 0], [0.25, 9, 0], [-9, 9, 0]]), QUAD)
    view = camera(moved(0, 0, 10), box_view(-0.5, 0.5, -0.5, 0.5))
    image = draw(scene([half], color=(0, 0, 0)), view, size=(1, 1), world=BACKGROUND, samples=samples)
    np.testing.assert_allclose(image[0, 0, :3], np.multiply(BACKGROUND, 0.25), rtol=1e-6)
    soft = draw(scene([half], color=(0, 0, 0)), view, size=(3, 3), world=BACKGROUND, samples=8)
    assert np.all(np.ptp(soft, axis=0) <= np.max(BACKGROUND) / 8 + 1e-5)


def floor_points(size: int = 32) -> Doubles:
    """The points of the floor that the pixels' centres of FROM_ABOVE show."""
    x = (np.arange(size) + 0.5) / size * 8 - 4
    return np.stack([*np.meshgrid(x, x), np.zeros((size, size))], -1)


def arriving(at: Doubles, source: Doubles) -> tuple[Doubles, Doubles]:
    """Distance to a source, and the cosine at the floor."""
    to_source = source - at
    distance = np.linalg.norm(to_source, axis=-1)
    return distance, to_source[..., 2] / distance


def test_point_light_gives_its_watts() -> None:
    place = np.array([1.0, 0.5, 2.0])
    image = draw(scene([FLOOR]), FROM_ABOVE, [light("POINT", moved(*place), 100.0, radius=0.0)], samples=1)
    distance, cosine = arriving(floor_points(), place)
    expected = 100 / (4 * np.pi) * cosine / distance**2 / np.pi
    np.testing.assert_allclose(image[..., 0], expected, rtol=1e-5)


def test_point_light_of_some_size_is_softer() -> None:
    place = np.array([1.0, 0.5, 2.0])
    image = draw(scene([FLOOR]), FROM_ABOVE, [light("POINT", moved(*place), 100.0, radius=0.8)], samples=256)
    distance, cosine = arriving(floor_points(), place)
    expected = 100 / (4 * np.pi) * cosine / (distance**2 + 0.8**2) / np.pi
    assert abs(image[..., 0].mean() / expected.mean() - 1) < 0.005


def test_sun_gives_its_watts_per_square_metre() -> None:
    tilt = looking((1, 2, 3), (0, 0, 0))
    expected = 3 * (3 / np.sqrt(14)) / np.pi
    for angle, tolerance in ((0.0, 1e-6), (0.6, 2e-3)):
        image = draw(scene([FLOOR]), FROM_ABOVE, [light("SUN", tilt, 3.0, angle=angle)], samples=64)
        np.testing.assert_allclose(image[..., 0].mean(), expected, rtol=tolerance)


@pytest.mark.parametrize("blend", [0.0, 0.4, 1.0])
def test_spot_light_fades_as_cycles_does(blend: float) -> None:
    place = looking((0.4, -0.3, 3), (0, 0, 0))
    spot = light("SPOT", place, 100.0, radius=0.0, spot_size=1.2, spot_blend=blend)
    image = draw(scene([FLOOR]), FROM_ABOVE, [spot], samples=1)
    points = floor_points()
    distance, cosine = arriving(points, place[:3, 3])
    off_axis = (points - place[:3, 3]) @ -place[:3, 2] / distance
    edge = np.cos(0.6)
    fade = (1 - edge) * blend
    x = np.clip((off_axis - edge) / fade, 0, 1) if fade > 0 else (off_axis > edge).astype(float)
    expected = 100 / (4 * np.pi) * cosine / distance**2 / np.pi * x * x * (3 - 2 * x)
    assert 100 < np.count_nonzero(expected) < 1000
    np.testing.assert_allclose(image[..., 0], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "size_y", "scale"),
    [("SQUARE", 9.0, 1.0), ("RECTANGLE", 2.0, 1.0), ("DISK", 9.0, 2.0), ("ELLIPSE", 2.0, 1.0)],
)
def test_area_light_gives_its_watts(shape: str, size_y: float, scale: float) -> None:
    place = looking((0.5, 0.2, 2), (0, 0, 0)) @ np.diag([scale, 1, 1, 1])
    area = light("AREA", place, 100.0, shape=shape, size=1.0, size_y=size_y)
    image = draw(scene([FLOOR]), FROM_ABOVE, [area], samples=256)
    grid = (np.arange(24) + 0.5) / 24 - 0.5
    spots = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    if shape in ("DISK", "ELLIPSE"):
        spots = spots[np.hypot(*spots.T) < 0.5]
    width, height = 1.0, 1.0 if shape in ("SQUARE", "DISK") else size_y
    expected = np.zeros((32, 32))
    for x, y in spots:
        source = place[:3, 3] + place[:3, 0] * x * width + place[:3, 1] * y * height
        distance, cosine = arriving(floor_points(), source)
        emitted = np.maximum(0, (floor_points() - source) @ -place[:3, 2] / distance)
        expected += 100 / np.pi * emitted * cosine / distance**2 / np.pi / len(spots)
    assert abs(image[..., 0].mean() / expected.mean() - 1) < 0.01


def test_area_light_shines_one_way() -> None:
    up = np.diag([1.0, -1.0, -1.0, 1.0])
    up[2, 3] = 2
    image = draw(scene([FLOOR]), FROM_ABOVE, [light("AREA", up, 100.0, size=1.0)])
    assert np.all(image[..., :3] == 0)


def test_lamp_in_the_ceilings_plane_is_not_hidden_by_it() -> None:
    ceiling = mesh(FLOOR["positions"] + np.array([0, 0, 3], np.float32), QUAD)
    view = camera(moved(0, 0, 2.5), box_view(-4, 4, -4, 4))
    area = light("AREA", moved(0, 0, 3), 100.0, size=1.0)
    both = draw(scene([FLOOR, ceiling]), view, [area])
    np.testing.assert_allclose(both, draw(scene([FLOOR]), view, [area]), atol=1e-6)


def test_lights_add_up_and_have_their_colours() -> None:
    red = light("POINT", moved(1, 1, 2), 50.0) | {"color": (1.0, 0.0, 0.25)}
    sun = light("SUN", moved(0, 0, 1), 2.0)
    what = scene([FLOOR], color=(0.5, 0.25, 1.0))
    together = draw(what, FROM_ABOVE, [red, sun], samples=1)
    apart = draw(what, FROM_ABOVE, [red], samples=1) + draw(what, FROM_ABOVE, [sun], samples=1)
    np.testing.assert_allclose(together[..., :3], apart[..., :3], rtol=1e-5)
    np.testing.assert_allclose(draw(what, FROM_ABOVE, [sun])[0, 0, :3], 2 / np.pi * np.array([0.5, 0.25, 1]), rtol=1e-5)


def test_world_lights_what_it_sees() -> None:
    world = (0.2, 0.4, 0.6)
    dark = light("POINT", moved(0, 0, 3), 0.0)
    image = draw(scene([FLOOR], color=(0.5, 0.5, 1)), FROM_ABOVE, [dark], world=world)
    np.testing.assert_allclose(image[16, 16, :3], [0.1, 0.2, 0.6], rtol=1e-5)
    under_a_lid = scene([FLOOR, mesh(FLOOR["positions"] * 100 + np.array([0, 0, 0.5], np.float32), QUAD)])
    view = camera(moved(0, 0, 0.4), box_view(-4, 4, -4, 4, near=0.01))
    assert np.all(draw(under_a_lid, view, [dark], world=world)[..., :3] == 0)


def test_soft_sky_lights_a_scene_without_lights() -> None:
    block = mesh(np.array([[1, -1, 0], [1, 1, 0], [1, 1, 2], [1, -1, 2]]), QUAD)
    image = draw(scene([FLOOR, block]), FROM_ABOVE, samples=64)
    open_floor, beside_block = image[16, 2, 0], image[16, 17, 0]
    assert 0.5 < open_floor <= 1
    assert beside_block < 0.85 * open_floor


def test_shadow_falls_where_the_light_is_hidden() -> None:
    block = mesh(np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]), QUAD)
    what = scene([FLOOR, block])
    below_block = camera(moved(0, 0, 0.9), box_view(-4, 4, -4, 4))
    sun = light("SUN", moved(0, 0, 1), 3.0, angle=0.0)
    image = draw(what, below_block, [sun], samples=1)
    expected = np.full((32, 32), 3 / np.pi)
    expected[12:20, 12:20] = 0
    np.testing.assert_allclose(image[..., 0], expected, rtol=1e-6)
    without = draw(what, below_block, [sun | {"shadow": False}], samples=1)
    np.testing.assert_allclose(without[..., 0], 3 / np.pi, rtol=1e-6)


def test_wider_sun_casts_softer_shadows() -> None:
    block = mesh(np.array([[-9, -9, 1], [0, -9, 1], [0, 9, 1], [-9, 9, 1]]), QUAD)
    below = camera(moved(0, 0, 0.9), box_view(-1, 1, -1, 1))
    rows = [
        draw(scene([FLOOR, block]), below, [light("SUN", moved(0, 0, 1), 1.0, angle=angle)], samples=64)[..., 0].mean(0)
        for angle in (0.0, 0.5, 1.2)
    ]
    between = [np.count_nonzero((row > 0.02 / np.pi) & (row < 0.98 / np.pi)) for row in rows]
    assert between[0] <= 1 < between[1] < between[2]


@pytest.mark.parametrize("far", [0.0, 500.0, 5000.0])
def test_convex_flat_faces_do_not_shade_themselves(far: float) -> None:
    # Whatever the light reaches by its angle it reaches indeed, also where float coordinates are coarse.
    vertices, triangles = sphere(20, 40)
    speck = mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) * 1e-3, np.array([[0, 1, 2]]))
    stretch = rotation(3) @ np.diag([1, 2, 0.3, 1])
    what = scene([mesh(vertices, triangles), speck], [placed(stretch), placed(moved(far, far, -far), 1)])
    view = camera(looking((3, -4, 2), (0, 0, 0)), frustum(-0.35, 0.35, -0.35, 0.35))
    for lamp in (
        light("SUN", looking((1, -1, 3), (0, 0, 0)), 3.0, angle=0.1),
        light("POINT", moved(3, 1, 4), 500.0, radius=0.3),
    ):
        shaded, unshaded = (draw(what, view, [lamp | {"shadow": shadow}], (96, 96)) for shadow in (True, False))
        assert np.count_nonzero(unshaded[..., 0]) > 2000
        np.testing.assert_array_equal(shaded, unshaded)


def test_coarse_smooth_sphere_does_not_shade_itself() -> None:
    # Its faces turn away from the sun before its normals do; shadow rays that began on them
    # would cut the light off in steps.
    vertices, triangles = sphere(6, 8)
    what = scene([mesh(vertices, triangles, normals=vertices)])
    view = camera(looking((0, -5, 0), (0, 0, 0)), box_view(-1.2, 1.2, -1.2, 1.2))
    sun = light("SUN", looking((3, -1, 0.5), (0, 0, 0)), np.pi, angle=0.0)
    shaded, unshaded = (draw(what, view, [sun | {"shadow": shadow}], (64, 64), samples=16) for shadow in (True, False))
    assert np.count_nonzero(unshaded[..., 0]) > 1000
    np.testing.assert_array_equal(shaded, unshaded)


def normalized(vectors: Doubles) -> Doubles:
    unit: Doubles = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


def test_thin_things_on_a_smooth_face_keep_their_shadow() -> None:
    # The smooth surface that these normals suggest bulges through the plate: what lies below it stays dark.
    corners = np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]])
    cushion = mesh(corners, QUAD, normals=normalized(corners + np.array([0, 0, 8])))
    plate = mesh(np.array([[-1, -1, 0.05], [1, -1, 0.05], [1, 1, 0.05], [-1, 1, 0.05]]), QUAD)
    below_plate = camera(moved(0, 0, 0.04), box_view(-0.9, 0.9, -0.9, 0.9, near=0.001))
    sun = light("SUN", moved(0, 0, 1), 1.0, angle=0.0)
    assert draw(scene([cushion]), below_plate, [sun])[..., 0].min() > 0.2
    assert draw(scene([cushion, plate]), below_plate, [sun])[..., 0].max() == 0


def mirrored(vertices: Floats) -> Floats:
    return vertices * np.array([-1, 1, 1], np.float32)


@pytest.mark.parametrize("normals", ["flat", "vertex", "corner"])
def test_mirrored_object_is_shaded_as_the_mirrored_mesh(normals: str) -> None:
    vertices, triangles = sphere(10, 16)
    vertices = vertices * np.array([1, 0.5, 0.7], np.float32) + np.array([0.3, 0, 0], np.float32)
    outward = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)

    def with_normals(points: Floats, faces: NDArray[np.int32], n: Floats) -> dict[str, Any]:
        return mesh(points, faces, {"flat": None, "vertex": n, "corner": n[faces]}[normals])

    view = camera(looking((1, -5, 2), (0, 0, 0)), frustum(-0.25, 0.25, -0.25, 0.25))
    lamp = light("SUN", looking((2, -2, 3), (0, 0, 0)), 3.0, angle=0.0)
    flip = placed(np.diag([-1.0, 1, 1, 1]))
    by_matrix = draw(scene([with_normals(vertices, triangles, outward)], [flip]), view, [lamp], (48, 48), samples=1)
    mesh_itself = with_normals(mirrored(vertices), triangles[:, ::-1], mirrored(outward))
    assert np.count_nonzero(by_matrix[..., 0]) > 200
    np.testing.assert_allclose(by_matrix, draw(scene([mesh_itself]), view, [lamp], (48, 48), samples=1), atol=2e-5)


def test_normals_follow_a_stretched_object() -> None:
    vertices, triangles = sphere(24, 48)
    matrix = rotation(1) @ np.diag([1.0, 3.0, 0.5, 1.0])
    view = camera(looking((4, -5, 2), (0, 0, 0)), frustum(-0.4, 0.4, -0.4, 0.4))
    lamp = light("SUN", looking((2, -2, 3), (0, 0, 0)), 3.0, angle=0.0)
    smooth = draw(scene([mesh(vertices, triangles, normals=vertices)], [placed(matrix)]), view, [lamp], (48, 48))
    flat = draw(scene([mesh(*sphere(200, 400))], [placed(matrix)]), view, [lamp], (48, 48))
    inside = (smooth[..., 0] > 0.05) & (flat[..., 0] > 0.05)
    assert np.count_nonzero(inside) > 150
    assert np.median(np.abs(smooth - flat)[inside]) < 0.01


def test_back_faces_are_lit_like_front_faces() -> None:
    sun = light("SUN", moved(0, 0, 1), 3.0)
    upside_down = mesh(FLOOR["positions"], QUAD[:, ::-1], np.tile(np.array([0, 0, -1], np.float32), (4, 1)))
    for what in (upside_down, upside_down | {"normals": None}):
        np.testing.assert_allclose(draw(scene([what]), FROM_ABOVE, [sun])[..., 0], 3 / np.pi, rtol=1e-6)


def test_hits_are_told_where_they_are_and_whose() -> None:
    """A tilted quad with normals at its corners, placed twice, and a ray that misses both."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    normals = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, 1], [-1, 0, 1]])
    what = scene([mesh(corners, QUAD, normals)], [placed(moved(1e5, 0, 0)), placed(moved(1e5, 0, -3))])
    world = what.arrays()
    tree = espalier_native.build(world["vertices"], world["triangles"])
    origins = np.array([[0.5, 0.25, 9], [0.5, 0.25, -9], [8, 8, 9]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, 1], [0, 0, -1]], np.float32)
    hits = tree.intersect(origins, directions)
    found = what.surface(hits["triangle"], hits["u"], hits["v"], directions)
    assert found["placement"].tolist() == [0, 1, -1]
    np.testing.assert_allclose(found["position"], np.array([[0.5, 0.25, 1.5], [0.5, 0.25, -1.5], [0, 0, 0]]), atol=1e-6)
    np.testing.assert_allclose(found["geometric_normal"], [[0, 0, 1], [0, 0, -1], [0, 0, 0]], atol=1e-12)
    leaning = np.array([0.5, 0, 1]) / np.hypot(0.5, 1)
    np.testing.assert_allclose(found["shading_normal"], np.array([leaning, -leaning, 0 * leaning]), atol=1e-6)
    with pytest.raises(IndexError, match="triangle 4 is not in the scene"):
        what.surface(np.array([4], np.int32), hits["u"][:1], hits["v"][:1], directions[:1])
    with pytest.raises(ValueError, match="directions"):
        what.surface(hits["triangle"], hits["u"], hits["v"], directions[:1])


def test_each_face_has_the_colour_of_its_slot() -> None:
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    two_faces = FLOOR | {"material_slots": np.array([0, 1], np.int32)}
    uses = [
        placed() | {"materials": np.array([2, 0], np.int32)},
        placed(moved(10, 0, 0)) | {"materials": np.array([1], np.int32)},
    ]
    what = espalier_native.Scene([two_faces], uses, colors)
    view = camera(moved(5, 0, 10), box_view(-9, 9, -4, 4))
    image = draw(what, view, [light("SUN", moved(0, 0, 1), np.pi)], (36, 16), samples=1)
    np.testing.assert_allclose(image[2, 12, :3], colors[2], atol=1e-6)
    np.testing.assert_allclose(image[12, 3, :3], colors[0], atol=1e-6)
    np.testing.assert_allclose(image[12, 23, :3], colors[1], atol=1e-6)
    np.testing.assert_allclose(image[2, 32, :3], colors[1], atol=1e-6, err_msg="a slot beyond takes the last")


def test_rows_run_from_bottom_to_top() -> None:
    upper = mesh(np.array([[-9, 0, 0], [9, 0, 0], [9, 9, 0], [-9, 9, 0]]), QUAD)
    seen = covered(draw(scene([upper]), FROM_ABOVE, world=BACKGROUND, samples=1))
    assert not seen[:16].any()
    assert seen[16:].all()


BUSY_LIGHTS = [
    light("POINT", moved(0.5, 0.5, 1), 20.0, radius=0.1),
    light("AREA", moved(0.2, 0.8, 1), 10.0, size=0.5, shape="DISK"),
]
LIGHTS_OF_ALL_KINDS = [
    *BUSY_LIGHTS,
    light("SPOT", moved(0.8, 0.2, 1), 30.0, spot_size=1.0, spot_blend=0.5, radius=0.05),
    light("SUN", moved(0, 0, 1), 0.5, angle=0.1),
]
BUSY_VIEW = camera(looking((0.5, -1, 1), (0.5, 0.5, 0)), frustum(-0.5, 0.5, -0.35, 0.35))


def test_picture_is_the_same_for_any_number_of_threads_and_quality() -> None:
    what = scene([mesh(*bumpy_sheet(60))])
    expected = draw(what, BUSY_VIEW, BUSY_LIGHTS, (70, 50), (0.1, 0.2, 0.3), threads=1)
    assert len(np.unique(expected)) > 1000
    for quality in ("draft", "balanced", "best", "exact"):
        for threads in (1, 2, 3, 8):
            image = draw(what, BUSY_VIEW, BUSY_LIGHTS, (70, 50), (0.1, 0.2, 0.3), threads=threads, quality=quality)
            assert image.tobytes() == expected.tobytes(), (quality, threads)


@pytest.mark.parametrize("target", espalier_native.simd_targets())
def test_picture_is_the_same_on_every_instruction_set(target: str) -> None:
    script = (
        "import sys\n"
        "from tests.test_native_render import *\n"
        "image = draw(scene([mesh(*bumpy_sheet(60))]), BUSY_VIEW, LIGHTS_OF_ALL_KINDS, (70, 50), (0.1, 0.2, 0.3))\n"
        "sys.stdout.buffer.write(image.tobytes())\n"
    )
    picture = output_of(script, ESPALIER_SIMD=target)
    expected = draw(scene([mesh(*bumpy_sheet(60))]), BUSY_VIEW, LIGHTS_OF_ALL_KINDS, (70, 50), (0.1, 0.2, 0.3))
    assert picture == expected.tobytes()


def test_result_tells_what_was_done() -> None:
    what = scene([mesh(*bumpy_sheet(30))])
    result = espalier_native.render(what, BUSY_VIEW, BUSY_LIGHTS, BLACK, 37, 21, threads=2, samples=3)
    trace = result["trace"]
    assert trace["primary_rays"] == 37 * 21 * 3
    assert 0 < trace["shadow_rays"] <= 2 * trace["primary_rays"]
    assert trace["threads"] == 2
    assert trace["samples"] == 3
    rays = trace["primary_rays"] + trace["shadow_rays"]
    assert trace["mrays_per_s"] == pytest.approx(rays / trace["trace_ms"] * 1e-3)
    assert result["placing_ms"] > 0
    assert result["build"]["triangles"] == what.triangle_count == 1800
    assert result["objects"] == what.objects


def test_empty_scene_is_all_background() -> None:
    image = draw(espalier_native.Scene([], [], np.zeros((0, 3), np.float32)), FROM_ABOVE, world=BACKGROUND)
    assert not covered(image).any()


def ok_arguments() -> dict[str, Any]:
    return {"scene": scene([FLOOR]), "camera": FROM_ABOVE, "lights": [], "world_color": BLACK, "width": 8, "height": 8}


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"width": 0}, ValueError, "width must be between 1"),
        ({"height": 10**6}, ValueError, "height must be between 1"),
        ({"samples": 0}, ValueError, "samples must be between 1"),
        ({"threads": -1}, ValueError, "threads must be between 0"),
        ({"quality": "ok"}, ValueError, "quality must be"),
        ({"world_color": (0, np.nan, 0)}, ValueError, "world_color must be finite"),
        ({"camera": {}}, ValueError, "camera has no entry 'type'"),
        ({"camera": 5}, TypeError, "camera must be a dict"),
        ({"camera": FROM_ABOVE | {"type": "PANO"}}, ValueError, "type must be 'PERSP' or 'ORTHO', not 'PANO'"),
        ({"camera": FROM_ABOVE | {"type": "PERSP"}}, ValueError, "type is PERSP but projection is orthographic"),
        ({"camera": FROM_ABOVE | {"projection": np.eye(3)}}, ValueError, r"projection must have shape \[4, 4\]"),
        ({"camera": FROM_ABOVE | {"projection": np.zeros((4, 4))}}, ValueError, "camera: "),
        ({"camera": FROM_ABOVE | {"matrix_world": np.eye(4) * np.nan}}, ValueError, "matrix_world is not finite"),
        ({"camera": FROM_ABOVE | {"matrix_world": "left"}}, TypeError, "matrix_world must be a 4x4 matrix"),
        ({"lights": [{}]}, ValueError, r"lights\[0\] has no entry 'type'"),
        ({"lights": [3]}, TypeError, r"lights\[0\] must be a dict"),
        ({"lights": [*BUSY_LIGHTS, light("LASER", np.eye(4), 1.0)]}, ValueError, r"lights\[2\]: type must be"),
        ({"lights": [light("POINT", np.eye(4), np.inf)]}, ValueError, r"lights\[0\]: .*energy must be finite"),
        ({"lights": [light("POINT", np.eye(4), 1.0, radius=-1.0)]}, ValueError, r"lights\[0\]: radius"),
        ({"lights": [light("POINT", np.eye(4), 1.0, radius="big")]}, TypeError, r"lights\[0\]: entry 'radius'"),
        ({"lights": [light("SPOT", np.eye(4), 1.0)]}, ValueError, r"lights\[0\] has no entry 'spot_size'"),
        (
            {"lights": [light("AREA", np.eye(4), 1.0, size=1.0, shape="STAR")]},
            ValueError,
            r"lights\[0\]: shape must be",
        ),
    ],
)
def test_pictures_are_refused(change: dict[str, Any], error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        espalier_native.render(**(ok_arguments() | change))
    with pytest.raises(error, match=says):
        espalier_native.start_preview(**(ok_arguments() | change))
