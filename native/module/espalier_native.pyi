# SPDX-License-Identifier: GPL-3.0-or-later
# Types only: shapes, units, frames and errors are told by the docstrings of the module itself.
from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

__version__: str

class Cancelled(RuntimeError): ...

def simd_targets() -> list[str]: ...
def hardware_threads() -> int: ...
def build(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32] | NDArray[np.uint32],
    quality: str = "balanced",
    threads: int = 0,
) -> Tree: ...

@final
class Tree:
    @property
    def report(self) -> dict[str, Any]: ...
    def intersect(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        t_min: float | NDArray[np.float32] = 0.0,
        t_max: float | NDArray[np.float32] = ...,
        threads: int = 0,
    ) -> dict[str, NDArray[Any]]: ...
    def occluded(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        t_min: float | NDArray[np.float32] = 0.0,
        t_max: float | NDArray[np.float32] = ...,
        threads: int = 0,
    ) -> NDArray[np.bool_]: ...
    def arrays(self) -> dict[str, NDArray[Any]]: ...

@final
class Scene:
    def __init__(
        self,
        meshes: Sequence[Mapping[str, Any]],
        placements: Sequence[Mapping[str, Any]],
        materials: NDArray[np.float32],
    ) -> None: ...
    @property
    def triangle_count(self) -> int: ...
    @property
    def centre(self) -> NDArray[np.float64]: ...
    @property
    def objects(self) -> list[dict[str, Any]]: ...
    @property
    def precision(self) -> dict[str, float]: ...
    def arrays(self) -> dict[str, NDArray[Any]]: ...
    def surface(
        self,
        triangle: NDArray[np.int32],
        u: NDArray[np.float32],
        v: NDArray[np.float32],
        directions: NDArray[np.float32],
    ) -> dict[str, NDArray[Any]]: ...

@final
class Job:
    @property
    def progress(self) -> float: ...
    @property
    def stage(self) -> str: ...
    @property
    def done(self) -> bool: ...
    def cancel(self) -> None: ...
    def wait(self, timeout: float | None = None) -> bool: ...
    def result(self) -> dict[str, Any]: ...
    def image(self) -> NDArray[np.float32] | None: ...

def start_preview(
    scene: Scene,
    camera: Mapping[str, Any],
    lights: Sequence[Mapping[str, Any]],
    world_color: Sequence[float] | NDArray[np.floating[Any]],
    width: int,
    height: int,
    *,
    quality: str = "balanced",
    threads: int = 0,
    samples: int = 4,
    on_demand: bool = False,
) -> Job: ...
def render(
    scene: Scene,
    camera: Mapping[str, Any],
    lights: Sequence[Mapping[str, Any]],
    world_color: Sequence[float] | NDArray[np.floating[Any]],
    width: int,
    height: int,
    *,
    quality: str = "balanced",
    threads: int = 0,
    samples: int = 4,
    on_demand: bool = False,
) -> dict[str, Any]: ...
def start_compare(
    scene: Scene, thread_counts: Sequence[int], *, quality: str = "balanced", repeats: int = 5
) -> Job: ...
