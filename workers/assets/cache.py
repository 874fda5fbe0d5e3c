"""Assets that a process keeps at hand, bounded by their memory."""

import sys
from collections import OrderedDict
from collections.abc import Callable, Hashable

from schemas.scene.shape import Asset


def asset_bytes(asset: Asset) -> int:
    """Memory that an asset's arrays take."""
    total = sys.getsizeof(asset)
    for part in asset.shape.parts:
        arrays = (part.vertices, part.faces, part.normals, part.uv, part.colors, part.material.texture)
        total += sum(array.nbytes for array in arrays if array is not None)
    return total


class AssetCache:
    """The assets used last, as many as `capacity_bytes` hold, but at least one."""

    def __init__(self, capacity_bytes: int) -> None:
        self.capacity_bytes = capacity_bytes
        self.bytes = 0
        self._assets: OrderedDict[Hashable, Asset] = OrderedDict()

    def __len__(self) -> int:
        return len(self._assets)

    def get(self, key: Hashable, load: Callable[[], Asset]) -> Asset:
        """The asset of this key, loaded if it is not here; what `load` raises passes through and leaves no trace."""
        if key in self._assets:
            self._assets.move_to_end(key)
            return self._assets[key]
        asset = load()
        self._assets[key] = asset
        self.bytes += asset_bytes(asset)
        while self.bytes > self.capacity_bytes and len(self._assets) > 1:
            self.bytes -= asset_bytes(self._assets.popitem(last=False)[1])
        return asset
