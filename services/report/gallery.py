"""The sections of the page that are pictures: sheets by category, the slider, the 3-D view. Pure: pictures to HTML."""

from collections.abc import Callable, Iterable, Sequence
from html import escape

import cv2
import numpy as np

from services.report.clouds import Space
from services.report.pictures import FIXED_REGIONS, OBJECT_REGIONS, Picture
from services.report.sample import ShownScene

Address = Callable[[Picture], str]
"""Where a page finds a picture: in itself or on its server."""

CELLS = ("input rgb", "input depth", "input mask", "mirror rgb", "mirror depth", "mirror mask", "over")


STRIP = ("input rgb", "mirror rgb", "mirror depth", "mirror mask")
"""What is shown of a scene where there is little room."""


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
    cells = "".join(_cell(scene, name, address) for name in CELLS if name in scene.pictures)
    several = f" · {len(scene.instances)} objects" if len(scene.instances) > 1 else ""
    compare = (
        f'<button type="button" class="quiet" data-compare="{scene.scene_id}">Compare</button>'
        if {"input rgb", "mirror rgb"} <= scene.pictures.keys()
        else ""
    )
    return (
        f'<article class="scene" data-category="{escape(scene.category)}" data-scene="{scene.scene_id}">'
        f"<header><h3>{escape(scene.category)} <span>scene {scene.scene_id}{several}</span></h3>{compare}</header>"
        f'<div class="cells">{cells}</div><p class="note">{escape(_facts(scene))}</p></article>\n'
    )


def _cell(scene: ShownScene, name: str, address: Address) -> str:
    picture = scene.pictures[name]
    words = f"{scene.category}, scene {scene.scene_id}: {picture.words}"
    caption = picture.words.replace(" view, ", " · ").replace("colour", "RGB")
    return (
        f'<figure class="{name.replace(" ", "-")}"><img loading="lazy" decoding="async" width="{picture.width}" '
        f'height="{picture.height}" alt="{escape(words)}" data-name="{name}" src="{address(picture)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _facts(scene: ShownScene) -> str:
    seen = [f"{share:.0%} visible in the {role} view" for role, share in scene.visible.items() if share is not None]
    distance = [f"d_z {scene.d_z_m:.3f} m"] if scene.d_z_m is not None else []
    return ", ".join([f"pose {scene.pose_id}", *seen, *distance])


def _legend() -> str:
    """Colours of depth and of regions."""
    steps = cv2.applyColorMap(np.linspace(255, 0, 9).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
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


def compare_html(scenes: Sequence[ShownScene]) -> str:
    """The slider between input and mirror view; the script takes the pictures from the sheets. Empty without pairs."""
    pairs = [scene for scene in scenes if {"input rgb", "mirror rgb"} <= scene.pictures.keys()]
    if not pairs:
        return ""
    options = "".join(
        f'<option value="{scene.scene_id}">{escape(scene.category)}, scene {scene.scene_id}</option>' for scene in pairs
    )
    kinds = "".join(
        f'<button type="button" data-kind="{kind}" aria-pressed="{"true" if kind == "rgb" else "false"}">{name}</button>'
        for kind, name in (("rgb", "RGB"), ("depth", "depth"), ("mask", "regions"))
    )
    return (
        f'<div class="tools"><label>Scene <select id="compare-scene">{options}</select></label>'
        f'<div class="chooser" role="group" aria-label="Images">{kinds}</div></div>'
        '<div class="wipe" id="wipe"><img id="wipe-mirror" alt=""><img id="wipe-input" alt=""><span class="tag left">input</span>'
        '<span class="tag right">mirror</span><span class="edge" aria-hidden="true"></span>'
        '<input id="wipe-range" type="range" min="0" max="100" value="50" aria-label="From mirror view to input view"></div>'
    )


def space_html(space: Space | None, data: str) -> str:
    """The 3-D view with its controls; `data` is what its script reads. Empty where there is nothing to show."""
    if space is None:
        return ""
    switches = [(f"{cloud.role} cloud", cloud.role) for cloud in space.clouds]
    switches += [("mesh", "mesh")] if space.bodies else []
    switches += [("cameras", "cameras")]
    boxes = "".join(
        f'<label><input type="checkbox" data-part="{part}" checked> {escape(name)}</label>' for name, part in switches
    )
    boxes += '<label><input type="checkbox" data-part="tint"> colour by camera</label>'
    missing = f" There is no mesh: {escape(space.missing)}." if space.missing else ""
    about = "the stored depth of both cameras as points, with the mesh as it was posed."
    keys = "Arrow keys turn, plus and minus zoom, 0 resets."
    return (
        f'<p class="sub">{escape(space.category)}, scene {space.scene_id}: {about}{missing}</p>'
        f'<div class="tools">{boxes}<button type="button" class="quiet" id="space-reset">Reset</button></div>'
        '<div class="space"><canvas id="space-canvas" tabindex="0" role="img" '
        f'aria-label="3-D view of the point clouds and the mesh. {keys}"></canvas></div>'
        f'<p class="note" id="space-note">Drag to turn. {keys} Click it before you zoom with the wheel.</p>'
        f'<script type="application/json" id="space-data">{data}</script>'
    )


def strip_html(scene: ShownScene, address: Address) -> str:
    """Four pictures of a scene, and its name."""
    pictures = [scene.pictures[name] for name in STRIP if name in scene.pictures]
    images = "".join(
        f'<img width="{one.width}" height="{one.height}" alt="{escape(f"scene {scene.scene_id}: {one.words}")}" '
        f'src="{address(one)}">'
        for one in pictures
    )
    name = f"{escape(scene.category)} <span>scene {scene.scene_id}</span>"
    return f"<figure><div>{images}</div><figcaption>{name}</figcaption></figure>"
