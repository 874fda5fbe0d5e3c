"""The pictures of scenes as HTML: sheets with a legend, strips, and the slider between the two views. Pure."""

from collections.abc import Callable, Iterable, Sequence
from html import escape

import numpy as np

from schemas.errors import plural
from schemas.scene.view import MODALITIES, PixelKind
from services.look.pictures import (
    FIXED_REGIONS,
    OBJECT_REGIONS,
    PATCH,
    SHOWN_ROLES,
    Picture,
    ShownCamera,
    ShownScene,
    series_of,
    viridis,
)

Address = Callable[[Picture], str]
"""Where a page finds a picture: in itself or on its server."""

CELLS = (*(f"{role} {kind}" for role in SHOWN_ROLES for kind in ("rgb", "depth", "region")), "over")
"""Pictures that a scene has without targets, beside its patches."""

STRIP = ("input rgb", "mirror rgb", "mirror depth", "mirror region", "input depth", "input region")
"""What is shown of a scene where there is little room: the first four that it has."""


def sheets_html(scenes: Sequence[ShownScene], address: Address) -> str:
    """Buttons for the categories, a legend, and the pictures of each scene."""
    if not scenes:
        return '<p class="empty">There are no scenes to show yet.</p>'
    names = sorted({scene.category for scene in scenes})
    buttons = "".join(
        f'<button type="button" data-show="{escape(name)}" aria-pressed="false">{escape(name or "all")}</button>'
        for name in ("", *names)
    )
    chooser = f'<div class="chooser" role="group" aria-label="Category">{buttons}</div>' if len(names) > 1 else ""
    return chooser + _legend() + "".join(_scene_html(scene, address) for scene in scenes)


def _scene_html(scene: ShownScene, address: Address) -> str:
    close = [name for name in scene.pictures if name.endswith(PATCH)]
    targets = [name for name in scene.pictures if name not in (*CELLS, *close)]
    several = f" · {len(scene.instances)} objects" if len(scene.instances) > 1 else ""
    compare = (
        f'<button type="button" class="quiet" data-compare="{scene.scene_id}">Compare</button>'
        if _in_both(scene)
        else ""
    )
    cells = ([] if targets else close) + [name for name in CELLS if name in scene.pictures]
    return (
        f'<article class="scene" data-category="{escape(scene.category)}" data-scene="{scene.scene_id}">'
        f"<header><h3>{escape(scene.category)} <span>scene {scene.scene_id}{several}</span></h3>{compare}</header>"
        f"{_targets(scene, targets, close, address) if targets else ''}{_cells('cells', scene, cells, address)}"
        f"{''.join(_camera(scene, camera, address) for camera in scene.cameras)}"
        f'<p class="note">{escape(_facts(scene))}</p></article>\n'
    )


def _targets(scene: ShownScene, targets: Sequence[str], close: Sequence[str], address: Address) -> str:
    """A row for each view: its patches, or its targets where it has none; folded up whole views and the rest of series."""
    later = {kind for kinds in series_of(MODALITIES).values() for kind in kinds[1:]}
    rows, folded = [], []
    for role in SHOWN_ROLES:
        near, whole = ([name for name in names if name.startswith(f"{role} ")] for names in (close, targets))
        first = [name for name in near or whole if name.split(" ")[1] not in later]
        rows.append(_cells("cells targets", scene, first, address))
        folded += [name for name in near + whole if name not in first]
    more = "<summary>Further targets, and those of the whole views</summary>"
    return "".join(rows) + (
        f"<details>{more}{_cells('cells targets', scene, folded, address)}</details>" if folded else ""
    )


def _camera(scene: ShownScene, camera: ShownCamera, address: Address) -> str:
    """A named camera: its views turning, in a strip, and folded up the strips of what else is stored of them."""
    turning = _cell(scene, "turning", camera.turning, address) if camera.turning else ""
    first, *others = (_cell(scene, name, picture, address) for name, picture in camera.strips.items())
    some = f"{camera.shown} of " if camera.shown < camera.views else ""
    more = f"<details><summary>What else is stored of them</summary>{''.join(others)}</details>" if others else ""
    return (
        f'<section class="camera"><h4>{escape(camera.name)} <span>{some}{plural(camera.views, "view")}</span></h4>'
        f'<div>{turning}<div class="strips">{first}{more}</div></div></section>'
    )


def _cells(kind: str, scene: ShownScene, names: Sequence[str], address: Address) -> str:
    return (
        f'<div class="{kind}">{"".join(_cell(scene, name, scene.pictures[name], address) for name in names)}</div>'
        if names
        else ""
    )


def _cell(scene: ShownScene, name: str, picture: Picture, address: Address) -> str:
    words = f"{scene.category}, scene {scene.scene_id}: {picture.words}"
    return (
        f'<figure class="{name.replace(" ", "-")}"><img loading="lazy" decoding="async" width="{picture.width}" '
        f'height="{picture.height}" alt="{escape(words)}" data-name="{name}" src="{address(picture)}">'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def _facts(scene: ShownScene) -> str:
    seen = [f"{share:.0%} visible in the {role} view" for role, share in scene.visible.items() if share is not None]
    distance = [f"d_z {scene.d_z_m:.3f} m"] if scene.d_z_m is not None else []
    return ", ".join([f"pose {scene.pose_id}", *seen, *distance])


def _legend() -> str:
    """Colours of depth and of regions."""
    steps = viridis()[np.linspace(255, 0, 9).astype(np.uint8)]
    width = 100 / len(steps)
    ramp = "".join(
        f'<rect x="{i * width:.2f}" width="{width + 0.5:.2f}" height="8" fill="{_hex(color)}"/>'
        for i, color in enumerate(steps.tolist())
    )
    regions = (("floor", FIXED_REGIONS[1]), ("table", FIXED_REGIONS[2]))
    swatches = "".join(f"<span>{_swatch([color])} {name}</span>" for name, color in regions)
    swatches += f"<span>{_swatch(OBJECT_REGIONS[:4])} objects</span>"
    return (
        f'<p class="legend"><span>near <svg viewBox="0 0 100 8" preserveAspectRatio="none" class="ramp" aria-hidden="true">'
        f"{ramp}</svg> far or farther</span><span>no depth: black</span>{swatches}</p>"
    )


def _swatch(colors: Iterable[Sequence[int]]) -> str:
    parts = list(colors)
    squares = "".join(f'<rect x="{12 * i}" width="10" height="10" fill="{_hex(c)}"/>' for i, c in enumerate(parts))
    return f'<svg class="swatch" width="{12 * len(parts)}" height="10" aria-hidden="true">{squares}</svg>'


def _hex(color: Sequence[int]) -> str:
    return "#" + "".join(f"{value:02x}" for value in color)


def _in_both(scene: ShownScene) -> list[PixelKind]:
    """The modalities that both views have a picture of."""
    return [kind for kind in MODALITIES if {f"{role} {kind}" for role in SHOWN_ROLES} <= scene.pictures.keys()]


def compare_html(scenes: Sequence[ShownScene]) -> str:
    """The slider between input and mirror view; the script takes the pictures from the sheets. Empty without pairs."""
    pairs = [scene for scene in scenes if _in_both(scene)]
    if not pairs:
        return ""
    options = "".join(
        f'<option value="{scene.scene_id}">{escape(scene.category)}, scene {scene.scene_id}</option>' for scene in pairs
    )
    all_series = series_of({kind for scene in pairs for kind in _in_both(scene)})
    kinds = "".join(
        f'<button type="button" data-kind="{" ".join(kinds)}" aria-pressed="{str(at == 0).lower()}">{escape(name)}</button>'
        for at, (name, kinds) in enumerate(all_series.items())
    )
    member = (
        '<label hidden><input id="wipe-member" type="range" min="0" value="0"><output id="wipe-told"></output></label>'
        if any(len(kinds) > 1 for kinds in all_series.values())
        else ""
    )
    close = (
        '<label><input id="wipe-close" type="checkbox"> close to the object</label>'
        if any(
            MODALITIES[kind].target and f"input {kind}{PATCH}" in one.pictures for one in pairs for kind in MODALITIES
        )
        else ""
    )
    return (
        f'<div class="tools"><label>Scene <select id="compare-scene">{options}</select></label>'
        f'<div class="chooser" role="group" aria-label="Images">{kinds}</div>{member}{close}</div>'
        '<div class="wipe" id="wipe"><img id="wipe-mirror" alt=""><img id="wipe-input" alt=""><span class="tag left">input</span>'
        '<span class="tag right">mirror</span><span class="edge" aria-hidden="true"></span>'
        '<input id="wipe-range" type="range" min="0" max="100" value="50" aria-label="From mirror view to input view"></div>'
    )


def strip_html(scene: ShownScene, address: Address) -> str:
    """At most four pictures of a scene, the last one of its named cameras, and its name."""
    turning = [camera.turning for camera in scene.cameras if camera.turning]
    plain = [scene.pictures[name] for name in STRIP if name in scene.pictures]
    pictures = [*plain[: 4 - len(turning[:1])], *turning[:1]]
    images = "".join(
        f'<img width="{one.width}" height="{one.height}" alt="{escape(f"scene {scene.scene_id}: {one.words}")}" '
        f'src="{address(one)}">'
        for one in pictures
    )
    name = f"{escape(scene.category)} <span>scene {scene.scene_id}</span>"
    return f"<figure><div>{images}</div><figcaption>{name}</figcaption></figure>"
