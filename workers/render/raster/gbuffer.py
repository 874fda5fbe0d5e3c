"""One pass, all labels: colour, depth and region id of every pixel from one draw into one framebuffer.

**Why an own pass.** pyrender's colour pass resolves four samples a pixel, so its depth and its ids disagree and neither
is at the pixel's centre; here there is one sample, at the centre, for everything. The context is pyrender's. The vertex
arrays are not: exact depth needs the plane of each face on the GPU, for which pyrender's `Primitive` has no attribute,
and it takes a draw call for each part.

**Depth.** Rasterisers move vertices to the nearest 1/256 px and interpolate in float32 from there. Instead, each
fragment intersects the ray through its pixel's centre with the plane of its face, made in float64: z = d / (n . ray).
Only where a face is seen so nearly edge-on that its plane says nothing does the interpolated z stand in. Measured over
200 scenes against float64 rays, p99.9 falls from 0.008 to 0.0015 mm on the floor and from 0.012 to 0.003 mm on tables.

**Order.** The depth test works on that same z, held as near / z, which in float32 keeps seven digits at any distance.
Things of a higher region id stand back along the face's normal by `STAND_BACK` of their distance for each step of order.py,
so that of coplanar faces the lowest region id wins, whatever their triangles.

**Rows.** Row 0 of the framebuffer is the image's top row: y runs down in clip space, nothing is flipped, and window
coordinates are image coordinates with pixel centres at +0.5. Both sides of every face are drawn.

**Tiers.** `raster` shades the same fragments by lighting.py; what it does to colour afterwards (smoothing.py, and
transparent texels cut out) leaves depth and region alone: to labels every face is solid.
"""

import ctypes
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.job.render import Render
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera, Intrinsics
from schemas.scene.scene import Placed
from schemas.scene.view import GBuffer
from workers.geometry.frames import invert
from workers.geometry.srgb import encode_srgb
from workers.render.overrides import AS_CALLED_FOR, Passes
from workers.render.raster.buffers import INDEX_BYTES, ShapeStore, TargetStore, UploadedShape
from workers.render.raster.colour import ColourTarget
from workers.render.raster.context import open_context
from workers.render.raster.counting import PixelCounter
from workers.render.raster.depth_bias import rank_regions
from workers.render.raster.drawing import Aim, Draw, ViewOf, sort_draws
from workers.render.raster.light_maps import SceneLight
from workers.render.raster.programs import NEAR_M, Program
from workers.render.raster.shaders import Variant, label_sources
from workers.render.raster.smoothing import OFFSETS_PX, blend, edges, smooth
from workers.render.raster.tiles import tiles

STAND_BACK = 2e-6
"""Share of its distance, along its normal, by which a face stands back for each step of order.py: 5
micrometres at 2.5 m. A quarter of it is the least that kept 400 pairs of coplanar squares apart."""

FLOOR_AHEAD = 1e-5
"""Share of its distance by which the floor is taken to be nearer than it is. Its depth in the test is the rasteriser's,
exact to 3e-6 of the distance, so that what things hide of it is not shaded; what is stored is the plane's, as everywhere."""

FLAT = Render(tier="flat")

_shared: "Renderer | None" = None


def shared_renderer() -> "Renderer":
    """This process's renderer, made at the first call: a process has one OpenGL context.

    Raises MachineError, with the packages to install, where there is no EGL or no OpenGL.
    """
    global _shared
    if _shared is None or _shared.closed:
        _shared = Renderer()
    return _shared


class Renderer:
    """Draws scenes; keeps on the GPU the shapes and framebuffers that were used lately.

    Make one a process, through `shared_renderer`, and use it from the thread that made it.
    """

    def __init__(self) -> None:
        self._gl, self._platform = open_context()
        gl = self._gl
        self.name: str = gl.glGetString(gl.GL_RENDERER).decode()
        """What OpenGL calls the device: tells a GPU from software."""
        self.closed = False
        self._shapes = ShapeStore(gl)
        self._in_use = 0  # by the scene drawn last, whose other views come next
        self._targets = TargetStore(gl)
        self._programs: dict[Variant, Program] = {}
        self._scene_light: SceneLight | None = None
        self._colour_target: ColourTarget | None = None
        self._rgba = np.empty((0, 0, 4), np.uint8)
        self._counter = PixelCounter(gl)
        for setting in (gl.GL_CULL_FACE, gl.GL_BLEND, gl.GL_DITHER, gl.GL_MULTISAMPLE):
            gl.glDisable(setting)
        gl.glFrontFace(gl.GL_CW)  # y runs down
        gl.glDepthFunc(gl.GL_GREATER)
        gl.glProvokingVertex(gl.GL_LAST_VERTEX_CONVENTION)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)

    def draw(
        self,
        things: Sequence[Placed],
        appearance: Appearance,
        camera: Camera,
        render: Render = FLAT,
        passes: Passes = AS_CALLED_FOR,
    ) -> GBuffer:
        """What the camera sees at the centre of every pixel; region and depth are 0 where nothing is hit.

        Depth and region do not depend on `render`, and nothing on `passes` as long as those that are left out are not
        called for. Faces nearer than 0.05 m along the optical axis are not seen. Raises
        ValueError above six lights.
        """
        self.prepare_light(things, appearance, render, passes)
        view = ViewOf(appearance, camera.intrinsics, invert(camera.T_world_cam), render.tier == "raster", passes)
        self._clear(camera.intrinsics, appearance)
        self._draw_things(things, view, Aim(labels=True, passes=passes))
        drawn = self._read(camera.intrinsics)
        if view.raster:
            drawn = self._refine(drawn, things, view, render.samples)
        self._in_use = len(things)
        self._shapes.trim(self._in_use)
        for image in (drawn.rgb, drawn.depth_m, drawn.region):
            image.setflags(write=False)
        return drawn

    def prepare_light(
        self, things: Sequence[Placed], appearance: Appearance, render: Render, passes: Passes = AS_CALLED_FOR
    ) -> None:
        """Make the maps of a scene's light, which all of its views share, unless they are there or nothing asks for them."""
        self._platform.make_current()
        raster = render.tier == "raster"
        if passes.draw("light_maps", raster):
            self._lit().prepare(things, appearance)
        elif raster:
            self._lit().prepare((), appearance)

    def count_pixels(self, thing: Placed, camera: Camera) -> int:
        """Pixels that a thing alone would cover, also outside the image, with nothing in front of it.

        The pixel grid is the image's, continued on all sides by one width and one height of the image: what lies
        beyond that, as of a thing that reaches behind the camera, is not counted.
        """
        self._platform.make_current()
        T_cam_shape = invert(camera.T_world_cam) @ thing.T_world_shape
        self._counter.program.use()
        self._counter.program.set_thing(T_cam_shape, 0, 0.0, 0.0)
        shape = self._shapes.fetch(thing.shape)
        self._cull(shape, T_cam_shape)
        count = sum(self._counter.count(shape, tile) for tile in tiles(thing.shape, T_cam_shape, camera.intrinsics))
        self._gl.glDisable(self._gl.GL_CULL_FACE)
        self._shapes.trim(max(1, self._in_use))
        return count

    def close(self) -> None:
        """Free everything on the GPU and the context itself; the renderer is of no use afterwards."""
        if self.closed:
            return
        self._platform.make_current()
        self._shapes.clear()
        self._targets.clear()
        for held in (*self._programs.values(), self._counter, self._scene_light, self._colour_target):
            if held is not None:
                held.free()
        self._platform.delete_context()
        self.closed = True

    def _draw_things(self, things: Sequence[Placed], view: ViewOf, aim: Aim) -> None:
        """Draw into what is bound."""
        ranks = rank_regions(things, [self._shapes.fetch(thing.shape).corners for thing in things])
        top_is_level = self._lit().top_is_level if view.raster else None
        for variant, draws in sort_draws(things, self._shapes.fetch, view.appearance, top_is_level, aim).items():
            program = self._program(variant)
            program.use()
            program.set_view(view.k)
            program.set_light(view.appearance, view.T_cam_world)
            if view.raster:
                program.set_ambience(view.appearance, view.T_cam_world)
            for draw in draws:
                if view.raster:
                    self._lit().bind(program, draw.thing)
                stand_back = STAND_BACK * ranks[draw.thing.region_id]
                ahead = FLOOR_AHEAD if variant.ground else -10.0 * stand_back
                T_cam_shape = view.T_cam_world @ draw.thing.T_world_shape
                program.set_thing(T_cam_shape, draw.thing.region_id, stand_back, ahead)
                self._cull(draw.shape, T_cam_shape, through_holes=not aim.labels)
                self._draw(draw, variant.textured)
        self._gl.glDisable(self._gl.GL_CULL_FACE)

    def _refine(self, drawn: GBuffer, things: Sequence[Placed], view: ViewOf, samples: int) -> GBuffer:
        """The same with holes cut out of colour and its edges made smooth."""
        rgb, cut = drawn.rgb, self._cuts_out(things, view)
        if cut:
            self._cut_out(rgb, things, view)
        mask = edges(rgb, drawn.region)
        if samples == 1:
            smooth(rgb, mask)
        else:
            self._colour().select(mask, view.k)
            moved = [self._draw_colour(things, view.moved(*offset), mask, cut) for offset in OFFSETS_PX]
            self._colour().release()
            blend(rgb, moved, mask)
        return GBuffer(rgb, drawn.depth_m, drawn.region)

    def _cuts_out(self, things: Sequence[Placed], view: ViewOf) -> bool:
        holes = any(batch.holes for thing in things for batch in self._shapes.fetch(thing.shape).batches)
        return view.passes.draw("transparency", holes)

    def _cut_out(self, rgb: NDArray[np.uint8], things: Sequence[Placed], view: ViewOf) -> None:
        """Put into `rgb` [H, W, 3] what is seen through clear texels: where two pictures differ, cut out and not.

        Only there, because colour alone is tested by another depth than labels are, and so may show another of two faces
        that meet.
        """
        whole, cut = (self._draw_colour(things, view, None, cut) for cut in (False, True))
        self._colour().release()
        seen_through = (whole != cut).any(axis=2)
        rgb[seen_through] = cut[seen_through, :3]

    def _draw_colour(
        self, things: Sequence[Placed], view: ViewOf, mask: NDArray[np.uint8] | None, cut: bool
    ) -> NDArray[np.uint8]:
        """[H, W, 4] uint8 sRGB; where there is a mask, it was selected before."""
        target = self._colour()
        if mask is None:
            target.select(None, view.k)
        target.clear(view.appearance)
        self._draw_things(things, view, Aim(labels=False, cut=cut, passes=view.passes))
        return target.read()

    def _lit(self) -> SceneLight:
        if self._scene_light is None:
            self._scene_light = SceneLight(self._gl, self._shapes)
        return self._scene_light

    def _colour(self) -> ColourTarget:
        if self._colour_target is None:
            self._colour_target = ColourTarget(self._gl)
        return self._colour_target

    def _clear(self, k: Intrinsics, appearance: Appearance) -> None:
        gl = self._gl
        self._targets.bind(k.width, k.height)
        gl.glEnable(gl.GL_DEPTH_TEST)
        background = np.append(encode_srgb(np.array(appearance.background)), 0.0)
        gl.glClearBufferfv(gl.GL_COLOR, 0, background.astype(np.float32))
        gl.glClearBufferfv(gl.GL_COLOR, 1, np.zeros(4, np.float32))
        gl.glClearBufferfv(gl.GL_DEPTH, 0, np.zeros(1, np.float32))

    def _program(self, variant: Variant) -> Program:
        if variant not in self._programs:
            self._programs[variant] = Program(self._gl, *label_sources(variant))
        return self._programs[variant]

    def _cull(self, shape: UploadedShape, T_cam_shape: Pose, through_holes: bool = False) -> None:
        """Leave out the backs of closed bodies, which nobody sees: unless the near plane cuts into them, or a texture."""
        gl = self._gl
        whole = bool((shape.corners @ T_cam_shape[2, :3] + T_cam_shape[2, 3] > NEAR_M).all())
        cut = through_holes and any(batch.holes for batch in shape.batches)
        (gl.glEnable if shape.closed and whole and not cut else gl.glDisable)(gl.GL_CULL_FACE)

    def _draw(self, draw: Draw, textured: bool) -> None:
        gl = self._gl
        gl.glBindVertexArray(draw.batch.vertex_array)
        if textured:
            own = draw.batch.texture
            gl.glBindTexture(gl.GL_TEXTURE_2D, self._shapes.textures.white if own is None else own.name)
        start = ctypes.c_void_p(INDEX_BYTES * draw.first)
        gl.glDrawElements(gl.GL_TRIANGLES, draw.count, gl.GL_UNSIGNED_INT, start)

    def _read(self, k: Intrinsics) -> GBuffer:
        gl = self._gl
        if self._rgba.shape[:2] != (k.height, k.width):
            self._rgba = np.empty((k.height, k.width, 4), np.uint8)
        rgba, depth = self._rgba, np.empty((k.height, k.width), np.float32)
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT0)
        gl.glReadPixels(0, 0, k.width, k.height, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, rgba)
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT1)
        gl.glReadPixels(0, 0, k.width, k.height, gl.GL_RED, gl.GL_FLOAT, depth)
        # OpenCV takes channels apart 20 times faster than a numpy slice is copied, and faster than GL_RGB is read.
        rgb: NDArray = cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB)
        region: NDArray = cv2.extractChannel(rgba, 3)
        return GBuffer(rgb, depth, region)
