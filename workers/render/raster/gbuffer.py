"""The renderer: colour, depth and region id of every pixel from one pass over the scene, and counts of covered pixels.

**One pass.** pyrender's colour pass resolves four samples a pixel, so its depth and its ids disagree and neither is at the
pixel's centre. Here one sample, at the centre, gives everything. The context is pyrender's. The vertex arrays are not:
exact depth needs each face's plane on the GPU, for which pyrender's `Primitive` has no attribute, and pyrender needs a
draw call for each part.

**Depth.** Rasterisers move vertices to the nearest 1/256 px and interpolate in float32 from there. Instead, each
fragment intersects the ray through its pixel's centre with the plane of its face, made in float64: z = d / (n . ray).
The interpolated z is used only where a face is so nearly edge-on that its plane does not determine z. Measured over
200 scenes against float64 rays, p99.9 falls from 0.008 to 0.0015 mm on the floor and from 0.012 to 0.003 mm on tables. Of a
floor of one colour that fills the image z is computed after the image is read (ground.py).

**Depth test.** It compares the same z as near / z, which in float32 keeps seven digits at any distance. A depth bias for
each region (`rank_regions`) lets the lowest region id win among coplanar faces, whatever their triangles.

**Rows.** Row 0 of the framebuffer is the image's top row: y runs down in clip space, nothing is flipped, and window
coordinates are image coordinates with pixel centres at +0.5. Both sides of every face are drawn.

**Colour.** The plan of effects decides what is drawn of it. Tier `raster` shades the same fragments with lit_shaders.py;
its antialiasing and its cut-out texels change colour alone: labels treat every face as solid.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FLOOR, Appearance
from schemas.scene.view import Camera, GBuffer, Intrinsics
from workers.geometry.camera import shown_part
from workers.geometry.frames import invert
from workers.geometry.pixels import fill_image, fill_plane_depth, fourth_channel, is_inner
from workers.render.raster.antialiasing import OFFSETS_PX, SPAN_PX, blend_samples, find_edges, smooth_edges
from workers.render.raster.buffers import INDEX_BYTES, ShapeStore, UploadedShape
from workers.render.raster.context import (
    Choice,
    ColourTarget,
    Framebuffer,
    choose,
    close_context,
    is_software,
    open_context,
)
from workers.render.raster.draw_calls import (
    DEPTH_BIAS,
    FLOOR_BIAS,
    Draw,
    Program,
    RenderPass,
    hides_backs,
    is_beyond_near,
    is_drawn,
    rank_regions,
    sort_draws,
)
from workers.render.raster.ground import TILE_PX, find_ground, level_plane, plain_srgb, tiles
from workers.render.raster.light_maps import LightMaps
from workers.render.raster.lit_shaders import EMPTY_FRAGMENT
from workers.render.raster.shaders import COUNT_VERTEX, Variant, label_sources
from workers.render.raster.sky import Sky

LAST_NUMBER = 255
"""The greatest number that a stencil of eight bits holds."""


class PixelCounter:
    """A stencil that lets each pixel pass once, and a query that counts what passes.

    Each count has a number of its own, which pixels take when they pass: so the stencil is cleared once in 255 counts.
    Each has a query of its own too: a driver draws what several of them count at once, when the first is finished.
    """

    def __init__(self, gl: ModuleType) -> None:
        self._gl = gl
        self.program = Program(gl, COUNT_VERTEX, EMPTY_FRAGMENT)
        self._unused: list[int] = []
        self._framebuffer = Framebuffer(gl, {gl.GL_STENCIL_ATTACHMENT: gl.GL_STENCIL_INDEX8})
        self._number = LAST_NUMBER

    def start(self, shape: UploadedShape, tile: Intrinsics) -> int:
        """The query of how many pixels of a tile, of at most `TILE_PX` a side, a shape covers; `program` holds its pose."""
        gl = self._gl
        self._framebuffer.bind(TILE_PX, TILE_PX)
        gl.glViewport(0, 0, tile.width, tile.height)
        gl.glDisable(gl.GL_DEPTH_TEST)
        gl.glEnable(gl.GL_STENCIL_TEST)
        if self._number == LAST_NUMBER:
            gl.glClearBufferiv(gl.GL_STENCIL, 0, np.zeros(1, np.int32))
            self._number = 0
        self._number += 1
        gl.glStencilFunc(gl.GL_NOTEQUAL, self._number, 0xFF)
        gl.glStencilOp(gl.GL_KEEP, gl.GL_REPLACE, gl.GL_REPLACE)
        self.program.set_view(tile)
        query = self._unused.pop() if self._unused else int(np.ravel(gl.glGenQueries(1))[0])
        gl.glBeginQuery(gl.GL_SAMPLES_PASSED, query)
        for batch in shape.batches:
            gl.glBindVertexArray(batch.vertex_array)
            gl.glDrawElements(gl.GL_TRIANGLES, batch.index_count, gl.GL_UNSIGNED_INT, None)
        gl.glEndQuery(gl.GL_SAMPLES_PASSED)
        gl.glDisable(gl.GL_STENCIL_TEST)
        return query

    def finish(self, query: int) -> int:
        """The number of pixels of a query that was started."""
        self._unused.append(query)
        return int(np.ravel(self._gl.glGetQueryObjectuiv(query, self._gl.GL_QUERY_RESULT))[0])


FLAT = Render(tier="flat")

FLAT_EFFECTS = EffectPlan(("rgb", "floor", "table", "textures"), {})
"""Everything that tier flat draws of any scene."""


_shared: dict[int, "Renderer"] = {}
"""This process's renderer, by the place of its device in EGL's list."""


def shared_renderer() -> "Renderer":
    """This process's renderer, made at the first call: a process has one OpenGL context at a time.

    Where Ray gives the process another GPU, it is closed and made anew there. Raises MachineError, with the packages to
    install, where there is no EGL or no OpenGL.
    """
    choice = choose()
    if choice.index not in _shared:
        while _shared:
            _shared.popitem()[1].close()
        _shared[choice.index] = Renderer(choice)
    return _shared[choice.index]


class Renderer:
    """Draws scenes; keeps the most recently used shapes on the GPU.

    Make one a process, through `shared_renderer`, and use it from the thread that made it.
    """

    def __init__(self, choice: Choice) -> None:
        self._gl, self._platform = open_context(choice.index)
        self.choice = choice
        gl = self._gl
        self.name: str = gl.glGetString(gl.GL_RENDERER).decode()
        """OpenGL's name of the device: tells a GPU from software."""
        self._shapes = ShapeStore(gl)
        self._scene_size = 0  # things of the scene drawn last, whose other views come next
        colors = {gl.GL_COLOR_ATTACHMENT0: gl.GL_RGBA8, gl.GL_COLOR_ATTACHMENT1: gl.GL_R32F}
        self._target = Framebuffer(gl, {**colors, gl.GL_DEPTH_ATTACHMENT: gl.GL_DEPTH_COMPONENT32F})
        self._programs: dict[Variant, Program] = {}
        self._ranked: tuple[Sequence[Placed], dict[int, int]] = (), {}
        self._light_maps = LightMaps(gl, self._shapes)
        self._colour_target = ColourTarget(gl)
        self._sky = Sky(gl)
        self._rgba = np.empty((0, 0, 4), np.uint8)
        self._counter = PixelCounter(gl)
        for setting in (gl.GL_CULL_FACE, gl.GL_BLEND, gl.GL_DITHER, gl.GL_MULTISAMPLE):
            gl.glDisable(setting)
        gl.glFrontFace(gl.GL_CW)  # y runs down
        gl.glDepthFunc(gl.GL_GREATER)
        gl.glProvokingVertex(gl.GL_LAST_VERTEX_CONVENTION)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)

    def close(self) -> None:
        """Ends the context; nothing can be drawn any more."""
        close_context(self._platform)

    def draw(
        self,
        things: Sequence[Placed],
        appearance: Appearance,
        camera: Camera,
        render: Render = FLAT,
        effects: EffectPlan = FLAT_EFFECTS,
    ) -> GBuffer:
        """What the camera sees at the centre of every pixel; region and depth are 0 where nothing is hit.

        RGB is None without the effect `rgb`, and in tier pathtraced, whose colour is traced. Depth and region do not
        depend on effects of colour. Faces nearer than 0.05 m along the optical axis are not seen. Raises ValueError above
        six lights.
        """
        self.prepare_light(things, appearance, render, effects)
        k, color = camera.intrinsics, effects.runs("rgb") and render.tier != "pathtraced"
        lit = _is_lit(render, effects)
        view = RenderPass(
            appearance, k, invert(camera.T_world_cam), effects, color, lit, open=lit and self._light_maps.absent
        )
        self._target.bind(k.width, k.height)
        self._gl.glEnable(self._gl.GL_DEPTH_TEST)
        ground = find_ground(things, view)
        self._target.clear(appearance, colors=ground is None)
        self._draw_things(things, view, ground is None)
        rgb, depth_m, region = self._read(view)
        if ground is not None:
            fill_plane_depth(depth_m, region, REGION_FLOOR, ground, view.k)
        if rgb is not None:
            put_behind(rgb, region == 0, appearance.backdrop)
            self._refine(rgb, region, things, view, render.samples)
            rgb.setflags(write=False)
        self._scene_size = len(things)
        self._shapes.trim(self._scene_size)
        depth_m.setflags(write=False)
        region.setflags(write=False)
        return GBuffer(rgb, depth_m, region)

    def prepare_light(
        self, things: Sequence[Placed], appearance: Appearance, render: Render, effects: EffectPlan
    ) -> None:
        """Make the light maps that all views of a scene share, where colour uses them or the plan forces them."""
        self._platform.make_current()
        lit = _is_lit(render, effects)
        if not lit and "light_maps" not in effects.forced:
            return
        # Maps that are forced where no colour uses them are made in full.
        shadows, occlusion = (not lit or effects.runs(name) for name in ("shadows", "ambient_occlusion"))
        self._light_maps.prepare(things if effects.runs("light_maps") else (), appearance, shadows, occlusion)

    def count_pixels(self, things: Sequence[Placed], camera: Camera) -> list[int]:
        """Pixels that each thing covers by itself, also outside the image, with nothing in front of it.

        The pixel grid is the image's, continued on all sides by one width and one height of the image; pixels beyond that,
        as of a thing that reaches behind the camera, are not counted.
        """
        self._platform.make_current()
        T_cam_world = invert(camera.T_world_cam)
        self._counter.program.use()
        started = []
        for thing in things:
            T_cam_shape = T_cam_world @ thing.T_world_shape
            self._counter.program.set_thing(T_cam_shape, 0, 0.0, 0.0)
            shape = self._shapes.fetch(thing.shape)
            self._cull(hides_backs(shape, is_beyond_near(shape, T_cam_shape)))
            views = tiles(thing.shape, T_cam_shape, camera.intrinsics)
            started.append([self._counter.start(shape, tile) for tile in views])
        self._gl.glDisable(self._gl.GL_CULL_FACE)
        counts = [sum(map(self._counter.finish, queries)) for queries in started]
        self._shapes.trim(max(1, self._scene_size))
        return counts

    def _draw_things(self, things: Sequence[Placed], view: RenderPass, ground_z: bool = True) -> None:
        """Draw into the bound framebuffer; z of the floor where `ground_z`."""
        ranks, fetch, has_level_top = self._rank(things), self._shapes.fetch, self._light_maps.has_level_top
        for variant, draws in sort_draws(things, fetch, view, has_level_top, ground_z).items():
            self._gl.glColorMaski(1, *([not variant.known_z] * 4))
            program = self._program(variant)
            program.use()
            program.set_view(view.k)
            if view.color:
                program.set_light(view.lights)
            if view.raster:
                program.set_ambience(view)
            for draw in draws:
                if view.raster and not view.open:
                    self._light_maps.bind(program, draw.thing)
                bias = DEPTH_BIAS * ranks[draw.thing.region_id]
                if variant.plain:
                    plane = level_plane(draw.thing.shape, draw.T_cam_shape)
                    program.set_plain(plain_srgb(draw.thing.shape, view, plane))
                nearer = FLOOR_BIAS if variant.ground else -10.0 * bias
                program.set_thing(draw.T_cam_shape, draw.thing.region_id, bias, nearer)
                self._cull(draw.culls)
                self._draw(draw, variant.textured)
        self._gl.glColorMaski(1, *([True] * 4))
        self._gl.glDisable(self._gl.GL_CULL_FACE)
        if view.raster and (surround := view.appearance.surround) is not None and surround.shown:
            self._sky.draw(view, surround)

    def _rank(self, things: Sequence[Placed]) -> dict[int, int]:
        """The ranks of `rank_regions`, found once for the views of one scene."""
        shapes = [self._shapes.fetch(thing.shape) for thing in things]  # all of them, as in use
        if things is not self._ranked[0]:
            ranks = rank_regions(things, [shape.corners for shape in shapes])
            if not isinstance(things, tuple):  # may hold other things the next time
                return ranks
            self._ranked = things, ranks
        return self._ranked[1]

    def _refine(
        self,
        rgb: NDArray[np.uint8],
        region: NDArray[np.uint8],
        things: Sequence[Placed],
        view: RenderPass,
        samples: int,
    ) -> None:
        """Cut holes out of `rgb` [H, W, 3] and antialias it, in place; `samples` of each edge pixel."""
        holes = any(batch.holes for thing in things for batch in self._shapes.fetch(thing.shape).batches)
        cut = view.raster and is_drawn(view.effects, "transparency", holes)
        if cut:
            self._cut_out(rgb, things, view)
        if not view.effects.runs("antialiasing"):
            return
        if view.effects.runs("alpha"):  # which has the outline: a blend with what is behind would darken it
            part = shown_part(region, round(SPAN_PX))  # no blend reaches farther
            inside = rgb[part].copy()
            if inside.size:
                smooth_edges(inside, find_edges(inside, region[part]) * is_inner(region[part]))
                rgb[part] = inside
            return
        mask = find_edges(rgb, region, sum(thing.region_id == REGION_FLOOR for thing in things) > 1)
        if not view.effects.runs("samples"):
            smooth_edges(rgb, mask)
            return
        self._colour_target.select(mask, view.k)
        moved = [self._draw_colour(things, view.shift(*offset), cut) for offset in OFFSETS_PX[: samples - 1]]
        self._gl.glDisable(self._gl.GL_STENCIL_TEST)
        blend_samples(rgb, moved, mask)

    def _cut_out(self, rgb: NDArray[np.uint8], things: Sequence[Placed], view: RenderPass) -> None:
        """Put into `rgb` [H, W, 3] what is seen through clear texels: where two images, with and without holes, differ.

        Other pixels stay, because a pass for colour alone has another depth test than labels have, and may show another
        of two faces that meet.
        """
        self._colour_target.bind(view.k.width, view.k.height)
        whole, cut = (self._draw_colour(things, view, cut) for cut in (False, True))
        seen_through = (whole != cut).any(axis=2)
        rgb[seen_through] = cut[seen_through, :3]

    def _draw_colour(self, things: Sequence[Placed], view: RenderPass, cut: bool) -> NDArray[np.uint8]:
        """[H, W, 4] uint8 sRGB of the pixels that were selected; `cut`: with holes cut out."""
        self._colour_target.clear(view.appearance)
        self._draw_things(things, replace(view, labels=False, cut=cut))
        drawn = self._colour_target.read(np.empty((view.k.height, view.k.width, 4), np.uint8))
        put_behind(drawn, drawn[..., 3] == 0, view.appearance.backdrop)
        return drawn

    def _program(self, variant: Variant) -> Program:
        if variant not in self._programs:
            self._programs[variant] = Program(self._gl, *label_sources(variant, not is_software(self.name)))
        return self._programs[variant]

    def _cull(self, culls: bool) -> None:
        gl = self._gl
        (gl.glEnable if culls else gl.glDisable)(gl.GL_CULL_FACE)

    def _draw(self, draw: Draw, textured: bool) -> None:
        gl = self._gl
        gl.glBindVertexArray(draw.batch.vertex_array)
        if textured:
            own = draw.batch.texture
            gl.glBindTexture(gl.GL_TEXTURE_2D, self._shapes.textures.white if own is None else own.name)
        start = ctypes.c_void_p(INDEX_BYTES * draw.first)
        gl.glDrawElements(gl.GL_TRIANGLES, draw.count, gl.GL_UNSIGNED_INT, start)

    def _read(self, view: RenderPass) -> tuple[NDArray[np.uint8] | None, NDArray[np.float32], NDArray[np.uint8]]:
        """(rgb, depth_m, region) of the bound framebuffer."""
        gl, k = self._gl, view.k
        if self._rgba.shape[:2] != (k.height, k.width):
            self._rgba = np.empty((k.height, k.width, 4), np.uint8)
        rgba, depth = self._target.read(self._rgba), np.empty((k.height, k.width), np.float32)
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT1)
        gl.glReadPixels(0, 0, k.width, k.height, gl.GL_RED, gl.GL_FLOAT, depth)
        # OpenCV splits channels 20 times faster than a numpy slice is copied, and faster than GL_RGB is read.
        rgb: NDArray | None = cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB) if view.color else None
        return rgb, depth, fourth_channel(rgba)


def put_behind(rgb: NDArray[np.uint8], nothing: NDArray[np.bool_], backdrop: NDArray[np.uint8] | None) -> None:
    """Puts a picture into the colours [H, W, 3 or 4] of the pixels that show nothing [H, W], as large as fills the image."""
    if backdrop is not None and nothing.any():
        rgb[nothing, :3] = fill_image(backdrop, nothing.shape[1], nothing.shape[0])[nothing]


def _is_lit(render: Render, effects: EffectPlan) -> bool:
    """Whether colour is drawn with the light of tier raster."""
    return effects.runs("rgb") and render.tier == "raster"
