"""GLSL of the label pass, of passes for colour alone, and of the pixel counter.

Values of a whole draw call (camera, region, light) reach the fragment shader in two ways, for speed alone. llvmpipe fetches
a uniform again for every fragment, which takes a third of the time of a floor that fills the image. It sets up every input
again for every triangle, which takes two thirds of the time of an object with 20,000 of them. So one text has two variants:
flat inputs where triangles are few, uniforms where they are many.
"""

from typing import NamedTuple

from workers.render.raster.batches import MATTE_ROUGHNESS
from workers.render.raster.lit_shaders import (
    LIT_FRAGMENT,
    LIT_VERTEX,
    PLANE_FRAGMENT,
    PLANE_VERTEX,
    SKY_FRAGMENT,
    SKY_VERTEX,
)

GRAZING = 0.01
"""Cosine of incidence below which a face's plane does not determine z."""


class Variant(NamedTuple):
    """The choices that one program is compiled for; `lights` is from 0, where none shines, to `MOST_LIGHTS`."""

    color: bool
    """False: depth and region alone, without textures and lights."""
    textured: bool
    few_triangles: bool
    matte: bool
    """Planar, and without highlights, whose light is therefore the same everywhere but for shadows: for the floor only."""
    lights: int
    raster: bool = False
    """Lit as in tier raster (lit_shaders.py)."""
    ground: bool = False
    """The floor: tested by the rasteriser's depth, so that its hidden fragments are not shaded."""
    level: bool = False
    """All of it lies on the level of its map, which then holds its shadows, or is `open`: for `raster` only."""
    open: bool = False
    """No light map darkens it, so that none is looked up, which takes half of the time of drawing: for `raster` only."""
    labels: bool = True
    """False: colour alone, tested by the rasteriser's depth, so that hidden fragments are not shaded."""
    cutout: bool = False
    """Its texture has holes. A variant of its own, because a program that may discard also shades hidden fragments."""
    planar: bool = False
    """Each face has the normal of its plane and one material, so that most of its light is found once: of few triangles."""
    known_z: bool = False
    """Its z is not drawn, as it is computed from its plane (ground.py): for `ground` only."""
    surround: bool = False
    """Lit from around by a map: for `raster` only. As the path tracer has it, what is rough mirrors nothing then."""

    @property
    def plain(self) -> bool:
        """Whether all of it has one colour, found before it is drawn."""
        return self.color and self.matte and not self.textured and not self.raster


SRGB_CURVE = (0.83375144, 0.29810974, 0.05531654, 0.07690398)
"""sRGB of linear light c as a c^(1/2) + b c^(1/4) - d c - e, from 0.0031308 on; below, sRGB is 12.92 c.

Within 0.1 of a step of 8 bits of 1.055 c^(1 / 2.4) - 0.055, and square roots cost a third of powers.
"""

_ENCODE_SRGB = f"""
vec3 encode_srgb(vec3 c) {{
#if !RASTER                        // whose tone curve ends at 1
    c = clamp(c, 0.0, 1.0);
#endif
    vec3 root = sqrt(c);
    vec3 curve = {SRGB_CURVE[0]} * root + {SRGB_CURVE[1]} * sqrt(root) - {SRGB_CURVE[2]} * c - {SRGB_CURVE[3]};
    return mix(12.92 * c, curve, greaterThanEqual(c, vec3(0.0031308)));
}}
"""

_VERTEX = """
layout(location = 0) in vec3 position;
layout(location = 1) in vec4 normal_metallic;
layout(location = 2) in vec4 albedo_roughness;
layout(location = 3) in vec2 uv;
layout(location = 4) in vec4 face_plane;

uniform mat4 cam_from_shape;
uniform mat4 clip_from_cam;
#if !PLANAR
out vec4 v_normal_metallic;
out vec4 v_albedo_roughness;
#endif
out vec2 v_uv;
flat out vec4 v_plane;
#if GROUND || !LABELS
uniform float nearer;
#endif

#if FEW_TRIANGLES
uniform vec3 ambient;
uniform vec3 light_towards[LIGHTS];
uniform vec3 light_color[LIGHTS];
#endif

#if FEW_TRIANGLES
uniform vec4 view;
uniform vec2 thing;
flat out vec4 v_view;
flat out vec2 v_thing;
#if !PLANAR
flat out vec3 v_ambient;
flat out vec3 v_light_towards[LIGHTS];
flat out vec3 v_light_color[LIGHTS];
#endif

void pass_on() {
    v_view = view;
    v_thing = thing;
#if !PLANAR
    v_ambient = ambient;
    for (int i = 0; i < LIGHTS; ++i) {
        v_light_towards[i] = light_towards[i];
        v_light_color[i] = light_color[i];
    }
#endif
}
#else
void pass_on() {}
#endif

#if RASTER
LIT_VERTEX
#endif

#if PLANAR
PLANE_VERTEX
#endif

void main() {
    pass_on();
#if RASTER
    pass_light();
#endif
    mat3 turn = mat3(cam_from_shape);
    vec3 shift = cam_from_shape[3].xyz;
    vec3 face_normal = turn * face_plane.xyz;
    v_plane = vec4(face_normal, face_plane.w + dot(face_normal, shift));
#if PLANAR
    light_plane();
#else
    v_normal_metallic = vec4(turn * normal_metallic.xyz, normal_metallic.w);
    v_albedo_roughness = albedo_roughness;
#endif
    v_uv = uv;
    gl_Position = clip_from_cam * vec4(turn * position + shift, 1.0);
#if GROUND || !LABELS
    gl_Position.z += nearer;
#endif
}
"""

_FRAGMENT = """
const float NEAR_M = 0.05;         // of any length: it scales what the depth test compares
const float HOLE = 0.5;          // texels more transparent than this are holes in colour, never in labels
const float GRAZING = GRAZING_COSINE;

#if !PLANAR
in vec4 v_normal_metallic;
in vec4 v_albedo_roughness;
#endif
in vec2 v_uv;
flat in vec4 v_plane;

#if FEW_TRIANGLES
flat in vec4 v_view;               // cx, cy, 1 / fx, 1 / fy
flat in vec2 v_thing;              // region id / 255, depth bias as a share of the distance
#if !PLANAR
flat in vec3 v_ambient;
flat in vec3 v_light_towards[LIGHTS];
flat in vec3 v_light_color[LIGHTS];
#endif
#else
uniform vec4 view;
uniform vec2 thing;
uniform vec3 ambient;
uniform vec3 light_towards[LIGHTS];
uniform vec3 light_color[LIGHTS];
#define v_view view
#define v_thing thing
#define v_ambient ambient
#define v_light_towards light_towards
#define v_light_color light_color
#endif

uniform sampler2D albedo_map;

layout(location = 0) out vec4 out_color_region;
#if LABELS
layout(location = 1) out float out_z;
#endif

#if RASTER
LIT_FRAGMENT
#endif

#if PLANAR
PLANE_FRAGMENT
#elif !RASTER
// Radiance towards the eye: Lambert, and GGX's lobe (Walter et al. 2007) with its masking term taken as 1. The lobe is
// written by the angle between the mirrored ray and the light, 1 - cos = 2 sin^2 of the half vector's, which saves the
// half vectors.
vec3 shade(vec3 normal, vec3 towards_eye, vec3 albedo, float metallic, float roughness) {
    vec3 diffuse = albedo * (1.0 - metallic);
    vec3 mirror = mix(vec3(0.04), albedo, metallic);
    vec3 sum = v_ambient * (diffuse + mirror);
    float width = max(roughness * roughness * roughness * roughness, 0.002);
    vec3 bounced = 2.0 * dot(normal, towards_eye) * normal - towards_eye;
    for (int i = 0; i < LIGHTS; ++i) {
        float level = max(dot(normal, v_light_towards[i]), 0.0);
        float miss = 1.0 - dot(bounced, v_light_towards[i]);
        float lobe = width / mix(0.5 * miss, 1.0, width);
        sum += v_light_color[i] * level * (diffuse + mirror * (0.25 / width * lobe * lobe));
    }
    return sum;
}
#endif

void main() {
    vec3 ray = vec3((gl_FragCoord.xy - v_view.xy) * v_view.zw, 1.0);
    float per_length = inversesqrt(dot(ray, ray));
    float across = dot(v_plane.xyz, ray);
    float cosine = abs(across) * per_length;
#if LABELS && !KNOWN_Z
    float z = cosine > GRAZING ? v_plane.w / across : 1.0 / gl_FragCoord.w;
    out_z = z;
#if !GROUND
    gl_FragDepth = NEAR_M / (z * (1.0 + v_thing.y / max(cosine, GRAZING)));
#endif
#endif

#if PLAIN
    out_color_region = vec4(v_plain_srgb, v_thing.x);
#elif COLOR
    vec3 tint = vec3(1.0);
#if TEXTURED
    vec4 texel = texture(albedo_map, v_uv);
    tint = texel.rgb * texel.rgb;
#if CUTOUT && !LABELS
    if (texel.a < HOLE) discard;
#endif
#endif
#if MATTE
    vec3 light = shade_plane(tint);
#elif PLANAR
    vec3 light = shade_plane(tint, ray * per_length, cosine);
#else
    vec3 face_normal = across > 0.0 ? -v_plane.xyz : v_plane.xyz;
    vec3 normal = v_normal_metallic.xyz;
    float length2 = dot(normal, normal);
    normal = length2 > 0.01 ? normal * inversesqrt(length2) : face_normal;
    normal = dot(normal, face_normal) < 0.0 ? -normal : normal;
    vec3 albedo = v_albedo_roughness.rgb * tint;
    vec3 light = shade(normal, -ray * per_length, albedo, v_normal_metallic.w, v_albedo_roughness.w);
#endif
#if RASTER
    light = tone_map(light);
#endif
    out_color_region = vec4(encode_srgb(light), v_thing.x);
#else
    out_color_region = vec4(vec3(0.0), v_thing.x);
#endif
}
"""

COUNT_VERTEX = """
#version 410 core
layout(location = 0) in vec3 position;
uniform mat4 cam_from_shape;
uniform mat4 clip_from_cam;

void main() {
    gl_Position = clip_from_cam * vec4(mat3(cam_from_shape) * position + cam_from_shape[3].xyz, 1.0);
}
"""


def label_sources(variant: Variant, hardware: bool) -> tuple[str, str]:
    """(vertex, fragment) shader of a variant; `hardware`: for a GPU, which may fuse a product with a sum."""
    choices = {**variant._asdict(), "plain": variant.plain, "dark": not variant.lights}
    choices["lights"] = max(1, variant.lights)  # no array is empty
    head = "#version 410 core\n" + "".join(f"#define {name.upper()} {int(v)}\n" for name, v in choices.items())
    head += f"#define UNFUSED {'precise' if hardware else ''}\n"
    shine = f"((roughness) < {MATTE_ROUGHNESS} ? 0.04 : 0.0)" if variant.surround else "0.04"
    head += f"#define DIELECTRIC(roughness) {shine}\n"
    vertex = _VERTEX.replace("LIT_VERTEX", LIT_VERTEX).replace("PLANE_VERTEX", PLANE_VERTEX)
    fragment = _FRAGMENT.replace("LIT_FRAGMENT", LIT_FRAGMENT).replace("PLANE_FRAGMENT", PLANE_FRAGMENT)
    fragment = fragment.replace("GRAZING_COSINE", str(GRAZING))
    return head + _ENCODE_SRGB + vertex, head + _ENCODE_SRGB + fragment


def sky_sources() -> tuple[str, str]:
    """(vertex, fragment) shader of the picture behind all surfaces."""
    return SKY_VERTEX, "#version 410 core\n#define RASTER 1\n" + _ENCODE_SRGB + SKY_FRAGMENT
