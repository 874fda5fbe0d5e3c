"""The views of a pair by name, and those of one named camera together, as arrays for training."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.layout import PixelKind, view_name
from schemas.errors import InputError
from schemas.scene.view import Role
from services.dataset.view import View


@dataclass(frozen=True, eq=False)
class NamedViews(Sequence[View]):
    """The N views of a camera that the job names, in order of their numbers; as arrays stacked over them."""

    views: tuple[View, ...]

    def __getitem__(self, number):  # type: ignore[no-untyped-def]
        return self.views[number]

    def __len__(self) -> int:
        return len(self.views)

    @property
    def T_world_cam(self) -> Array:
        """[N, 4, 4] float64: camera coordinates (x right, y down, z forward) to world coordinates, metres."""
        return np.stack([view.T_world_cam for view in self.views])

    @property
    def K(self) -> Array:
        """[N, 3, 3] float64 intrinsics, pixels; the centre of pixel (column i, row j) is at (i + 0.5, j + 0.5)."""
        return np.stack([view.K for view in self.views])

    def image(self, kind: PixelKind) -> NDArray:
        """[N, H, W] or [N, H, W, C]: the images of any kind, as `View.image`."""
        return self._stack(lambda view: view.image(kind))

    def rgb(self) -> NDArray[np.uint8]:
        """[N, H, W, 3] uint8 sRGB."""
        return self._stack(View.rgb)

    def alpha(self) -> NDArray[np.uint8]:
        """[N, H, W] uint8: the share of each pixel that is covered, as 255."""
        return self._stack(View.alpha)

    def depth_m(self) -> NDArray[np.float32]:
        """[N, H, W] float32: z along the optical axis, metres; 0 where unknown."""
        return self._stack(View.depth_m)

    def segment(self) -> NDArray[np.uint8]:
        """[N, H, W] uint8 region ids."""
        return self._stack(View.segment)

    def normals(self) -> NDArray[np.float32]:
        """[N, H, W, 3] float32: unit normals in each camera's frame."""
        return self._stack(View.normals)

    def _stack(self, read: Callable[[View], NDArray]) -> NDArray:
        return np.stack([read(view) for view in self.views])


class Views(Mapping[Role, View]):
    """The views of a pair by name: `views["input"]`, `views["around", 3]`, and all of a camera by `views("around")`."""

    def __init__(self, views: Mapping[str, View]) -> None:
        self._views = views

    def __getitem__(self, name: str | tuple[str, int]) -> View:
        return self._views[name if isinstance(name, str) else view_name(*name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def __call__(self, name: str) -> NamedViews:
        """All views of a camera that the job names. Raises InputError naming those that there are."""
        named = {view.role: 0 for view in self._views.values() if view.number is not None}
        if name not in named:
            there = f"it has {', '.join(named)}" if named else "its job has no cameras.more"
            raise InputError(f"this pair has no views of a camera named {name!r}: {there}")
        return NamedViews(tuple(view for view in self._views.values() if view.role == name))
