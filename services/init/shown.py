"""The files of a folder as its job has them: sizes as they will stand, the axis that is up, and how they are loaded."""

from collections.abc import Sequence
from dataclasses import dataclass

from schemas.job.assets import FolderSource
from services.init.model import Item
from services.init.table import describe_size, describe_up, missing_pictures
from workers.assets.catalogue import Catalogue, InstanceRef


@dataclass(frozen=True)
class Shown:
    """A file as the table, the pictures and `--json` have it. size_m: width, depth and height as it will stand.

    up: the axis that the job has up; shape_says, confidence: what the shape tells about it.
    """

    path: str
    category: str
    size_m: tuple[float, float, float]
    vertices: int
    faces: int
    watertight: bool
    textures: int
    missing_textures: int
    up: str
    shape_says: str | None
    confidence: str | None
    notes: tuple[str, ...]

    @property
    def pictures(self) -> str:
        """How many pictures were found, of how many where some are missing or cannot be read."""
        return f"{self.textures}" + (f" of {self.textures + self.missing_textures}" if self.missing_textures else "")

    @property
    def row(self) -> tuple[str, ...]:
        """Its line of the table."""
        closed = "yes" if self.watertight else "no"
        size, up = describe_size(self.size_m), describe_up(self.up, self.shape_says, self.confidence)
        return self.path, self.category, size, str(self.faces), closed, self.pictures, up, "; ".join(self.notes)

    @property
    def caption(self) -> tuple[str, ...]:
        """Its lines below the picture."""
        closed = "closed" if self.watertight else "not closed"
        up = describe_up(self.up, self.shape_says, self.confidence)
        return (
            self.path,
            f"{self.category}, {describe_size(self.size_m)} cm, up: {up}",
            f"{self.faces} faces, {closed}, pictures: {self.pictures}",
        )


def show_items(catalogue: Catalogue, items: Sequence[Item]) -> list[tuple[Shown, InstanceRef]]:
    """The items as the job's catalogue has them, and how each is loaded."""
    places = {
        entry.files[0].path: (source, category, index)
        for source, listing in enumerate(catalogue.objects)
        for category, entries in (listing.entries.items() if listing is not None else ())
        for index, entry in enumerate(entries)
    }
    return [_show(catalogue, item, *places[item.path]) for item in items]


def _show(catalogue: Catalogue, item: Item, source: int, category: str, index: int) -> tuple[Shown, InstanceRef]:
    settings, measured = catalogue.assets.objects[source], item.measured
    assert isinstance(settings, FolderSource)
    up = settings.up_of(item.path)
    scale = settings.scale if settings.diagonal_m is None else settings.diagonal_m / item.diagonal
    x, y, z = (scale * extent for extent in measured.extents)
    shown = Shown(
        path=item.path,
        category=category,
        size_m={"x": (z, y, x), "y": (x, z, y), "z": (x, y, z)}[up],
        vertices=measured.vertices,
        faces=measured.faces,
        watertight=measured.watertight,
        textures=measured.textures,
        missing_textures=missing_pictures(measured.notes),
        up=up,
        shape_says=measured.up,
        confidence=measured.confidence,
        notes=measured.notes,
    )
    return shown, catalogue.refer(source, category, index)
