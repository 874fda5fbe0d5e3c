"""GLSL of tier `raster`: one light with shadows; ambient occlusion of the sky and of the other lights.

Occlusion and shadows are looked up in the light maps that baking.py makes once a scene: the *level* maps of the floor and
of the plane that objects stand on, and the key light's shadow map.

Of planar faces of one material, what of their light is the same everywhere is computed once a face, in its last vertex. The
light is that of the general `shade` of each tier, written in other terms: a plane mirrors a light instead of every ray, so that
the cosine between a mirrored ray and a light is that between the ray and the mirrored light. `UNFUSED` keeps a GPU from fusing
a product with a sum, which it would do in other places without a texture than with a white one: a pass that is forced must
change no byte. llvmpipe fuses nothing, and the word would cost it 2 % of the time of drawing.
"""

KNEE = 0.8
"""Up to here the image is proportional to light; above, it approaches 1 without reaching it."""

ASIDE_M = 0.014
"""Distance in front of a wall at which its level map is looked up: somewhat more than a pixel of the elevation grid."""

TONE = """
// Tone curve: linear below the knee, approaching 1 above it.
vec3 tone_map(vec3 c) {
    vec3 over = max(c - KNEE, 0.0);
    return min(c, KNEE) + (1.0 - KNEE) * over / ((1.0 - KNEE) + over);
}
""".replace("KNEE", str(KNEE))

AROUND = """
// Radiance of a white surface by its normal (workers/geometry/irradiance.py); of what a surface mirrors too: a reflection as
// broad as Lambert's lobe.
uniform vec3 around[18];

vec3 around_of(vec3 n) {
    vec3 s = n * n, m = n.xyx * n.yzz;
    vec3 sum = around[0] * n.x + around[1] * n.y + around[2] * n.z;
    sum += s.x * (around[3] * s.x + around[4] * m.x + around[5] * m.z + around[6] * s.y + around[7] * m.y + around[8] * s.z);
    sum += s.y * (around[9] * m.x + around[10] * m.z + around[13] * s.y + around[14] * m.y + around[15] * s.z);
    return max(sum + s.z * (around[11] * m.x + around[12] * m.z + around[16] * m.y + around[17] * s.z), 0.0);
}
"""

LIT_VERTEX = """
uniform vec3 up;                   // the world's, in the optical frame
uniform vec3 below;
#if SURROUND
AROUND_TERMS
#endif
#if !OPEN
uniform mat4 level_from_shape;     // to (u, v, elevation above the level in units of its map)
out vec3 v_level;
#endif
#if !LEVEL
uniform mat4 shadow_from_shape;    // to (u, v, depth) of the shadow map
uniform mat3 shadow_normal;        // inverse transpose of its linear part
out vec3 v_shadow;
flat out vec2 v_slope;
flat out vec2 v_aside;
#endif
#if FEW_TRIANGLES && !PLANAR
flat out vec3 v_up;
flat out vec3 v_below;
#endif

void pass_light() {
#if !OPEN
    v_level = (level_from_shape * vec4(position, 1.0)).xyz;
#endif
#if !LEVEL
    v_shadow = (shadow_from_shape * vec4(position, 1.0)).xyz;
    // A face's plane n . p = d is a plane in the map too, where depth changes by -n_xy / n_z.
    vec3 n = shadow_normal * face_plane.xyz;
    v_slope = abs(n.z) > 1e-6 * length(n) ? clamp(-n.xy / n.z, -40.0, 40.0) : vec2(0.0);
    v_aside = ASIDE_M * (mat3(level_from_shape) * face_plane.xyz).xy;
#endif
#if FEW_TRIANGLES && !PLANAR
    v_up = up;
    v_below = below;
#endif
}
""".replace("ASIDE_M", str(ASIDE_M)).replace("AROUND_TERMS", AROUND)

LIT_FRAGMENT = """
#if !OPEN
in vec3 v_level;
#endif
#if FEW_TRIANGLES && !PLANAR
flat in vec3 v_up;
flat in vec3 v_below;
#elif !PLANAR
uniform vec3 up;
uniform vec3 below;
#define v_up up
#define v_below below
#endif
#if SURROUND
AROUND_TERMS
#define AROUND_OF(direction) around_of(direction)
#else
#define AROUND_OF(direction) mix(v_below, v_ambient, 0.5 + 0.5 * dot(direction, v_up))
#endif
#if !OPEN
uniform sampler2D level_map;
#endif

#if !LEVEL
in vec3 v_shadow;
flat in vec2 v_slope;
flat in vec2 v_aside;
uniform sampler2DShadow shadow_map;
uniform vec3 softness;             // filter radius, depth bias and pixel size of the shadow map
const vec2 RING[4] = vec2[4](vec2(0.92, 0.38), vec2(-0.38, 0.92), vec2(-0.92, -0.38), vec2(0.38, -0.92));

// Share of the key light that arrives. On the level it is in the map; elsewhere each tap compares with the face's own
// plane, so that no face shades itself. A loop that ends after one turn instead of a branch, because llvmpipe skips a loop
// that no fragment enters: none does on the level or on a face turned away from the light.
float key_share(float on_map, float facing) {
    bool on_level = abs(v_level.z) < 0.01, inside = all(lessThan(abs(v_level.xy - 0.5), vec2(0.5)));
    int taps = facing <= 0.0 ? 0 : on_level ? (inside ? 0 : 1) : 4;
    // The map's pixels hold the depth of their centres, up to a pixel away from the point that is compared.
    float depth = v_shadow.z - softness.y - dot(abs(v_slope), vec2(softness.z));
    float share = on_map;
    for (int turn = 0; turn < min(taps, 1); ++turn) {
        vec4 lit;
        for (int i = 0; i < 4; ++i) {
            vec2 d = RING[i] * softness.x;
            lit[i] = textureLod(shadow_map, vec3(v_shadow.xy + d, min(depth + dot(v_slope, d), 1.0)), 0.0);
        }
        share = taps == 1 ? lit[0] : (lit[0] + lit[1] + lit[2] + lit[3]) / 4.0;
    }
    return share;
}
#endif

TONE
// What arrives of the sky and of the other lights, and of the key light; `facing`: the cosine of the latter's direction.
vec2 arriving(float facing) {
#if OPEN
    return vec2(1.0);
#elif LEVEL
    return textureLod(level_map, v_level.xy, 0.0).ra;
#else
    // A wall looks the map up in front of itself, where the map does not jump. Points high above the things there see more
    // of the sky.
    vec4 level = textureLod(level_map, v_level.xy + v_aside, 0.0);
    float open = mix(level.r, level.g, clamp(v_level.z / max(level.b, 0.004), 0.0, 1.0));
    open = v_level.z < -0.01 ? 1.0 : mix(open, 1.0, clamp(2.5 * (v_level.z - level.b), 0.0, 1.0));
    return vec2(open, key_share(level.a, facing));
#endif
}

#if !PLANAR
uniform float sheen;               // share of Fresnel's mirrored light at grazing angles that is drawn
// Lambert, GGX's lobe as in the flat tier with Schlick's Fresnel, and a sky over a ground (hemispherical ambient).
vec3 shade(vec3 normal, vec3 towards_eye, vec3 albedo, float metallic, float roughness) {
    vec2 arrives = arriving(dot(normal, v_light_towards[0]));
    float open = arrives.x, lit = arrives.y;
    vec3 diffuse = albedo * (1.0 - metallic);
    vec3 mirror = mix(vec3(DIELECTRIC(roughness)), albedo, metallic);
    vec3 around = AROUND_OF(normal) * open;
    float facing = clamp(dot(normal, towards_eye), 0.0, 1.0), miss_eye = 1.0 - facing;
    float grazing = miss_eye * miss_eye * miss_eye * miss_eye * miss_eye * (1.0 - roughness) * sheen;
    mirror += (1.0 - mirror) * grazing;
    float width = max(roughness * roughness * roughness * roughness, 0.002);
    vec3 bounced = 2.0 * dot(normal, towards_eye) * normal - towards_eye;
    vec3 sum = around * diffuse + AROUND_OF(bounced) * open * mirror;
    for (int i = 0; i < LIGHTS && DARK == 0; ++i) {
        float reach = max(dot(normal, v_light_towards[i]), 0.0) * (i == 0 ? lit : open);
        float miss = 1.0 - dot(bounced, v_light_towards[i]);
        float lobe = width / mix(0.5 * miss, 1.0, width);
        sum += v_light_color[i] * reach * (diffuse + mirror * (0.25 / width * lobe * lobe));
    }
    return sum;
}
#endif
""".replace("TONE", TONE).replace("AROUND_TERMS", AROUND)

CAST_VERTEX = """
#version 410 core
layout(location = 0) in vec3 position;
uniform mat4 clip_from_shape;

void main() { gl_Position = clip_from_shape * vec4(position, 1.0); }
"""

EMPTY_FRAGMENT = """
#version 410 core
void main() {}
"""

MASK_VERTEX = """
#version 410 core
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(corner, 0.0, 1.0);
}
"""

SKY_VERTEX = MASK_VERTEX.replace("0.0, 1.0)", "-1.0, 1.0)")
"""The same triangle infinitely far away."""

SKY_FRAGMENT = """
const float PI = 3.14159265;
uniform vec4 view;                 // cx, cy, 1 / fx, 1 / fy
uniform mat3 map_from_cam;
uniform float scale;
uniform sampler2D sky;
layout(location = 0) out vec4 out_color_region;

TONE
void main() {
    vec3 ray = normalize(map_from_cam * vec3((gl_FragCoord.xy - view.xy) * view.zw, 1.0));
    vec2 at = vec2(0.5 - atan(ray.y, ray.x) / (2.0 * PI), acos(clamp(ray.z, -1.0, 1.0)) / PI);
    out_color_region = vec4(encode_srgb(tone_map(scale * textureLod(sky, at, 0.0).rgb)), 0.0);
}
""".replace("TONE", TONE)

MASK_FRAGMENT = """
#version 410 core
uniform sampler2D mask;
void main() { if (texelFetch(mask, ivec2(gl_FragCoord.xy), 0).r == 0.0) discard; }
"""


PLANE_VERTEX = """
// Light towards the eye, per unit of a texel's: from the sky and all lights without shadows, and from the key light with
// them. On a matte plane `v_plane_mirror` is the part that a texel does not tint, and GGX's lobe, under 0.03 of the light, is
// left out; where there are neither texels nor shadows, all of it has one colour, which ground.py finds.
#if PLAIN
uniform vec3 plain_srgb;
flat out vec3 v_plain_srgb;

void light_plane() { v_plain_srgb = plain_srgb; }
#else
flat out vec3 v_plane_open;
#if RASTER
flat out vec3 v_plane_key;
#endif
#if MATTE
flat out vec3 v_plane_mirror;
#else
flat out vec3 v_ambient;
flat out vec3 v_tinted;            // part of the mirrored light that a texel tints
flat out vec4 v_gloss;             // untinted part of it, (1 - roughness) sheen, offset of the lobes, cosine of the key light
flat out vec3 v_lobe[LIGHTS];      // mirrored lights, scaled to the lobe
flat out vec3 v_gain[LIGHTS];
#if RASTER
uniform float sheen;
flat out vec3 v_below;
flat out vec3 v_mirrored_up;
#else
const float sheen = 1.0;
#endif
#endif

void light_plane() {
    vec3 normal = v_plane.w > 0.0 ? -v_plane.xyz : v_plane.xyz;    // towards the eye
#if SURROUND
    vec3 around = around_of(normal);
#elif RASTER
    vec3 around = mix(below, ambient, 0.5 + 0.5 * dot(normal, up));
#else
    vec3 around = ambient;
#endif
    vec3 diffuse = albedo_roughness.rgb * (1.0 - normal_metallic.w), mirror = DIELECTRIC(albedo_roughness.w) * around;
    for (int i = RASTER; i < LIGHTS; ++i) around += light_color[i] * max(dot(normal, light_towards[i]), 0.0);
    v_plane_open = diffuse * around;
#if RASTER
    v_plane_key = diffuse * light_color[0] * max(dot(normal, light_towards[0]), 0.0);
#endif
#if MATTE
    v_plane_mirror = mirror;
#else
    float metallic = normal_metallic.w, roughness = albedo_roughness.w;
    float width = max(roughness * roughness * roughness * roughness, 0.002);
    v_ambient = ambient;
    v_tinted = albedo_roughness.rgb * metallic;
    float untinted = DIELECTRIC(roughness) * (1.0 - metallic);
    v_gloss = vec4(untinted, (1.0 - roughness) * sheen, 0.5 + 0.5 / width, dot(normal, light_towards[0]));
    for (int i = 0; i < LIGHTS; ++i) {
        float cosine = dot(normal, light_towards[i]);
        v_lobe[i] = (0.5 - 0.5 / width) * (light_towards[i] - 2.0 * cosine * normal);
        v_gain[i] = 0.25 / width * max(cosine, 0.0) * light_color[i];
    }
#if RASTER
    v_below = below;
    v_mirrored_up = up - 2.0 * dot(normal, up) * normal;
#endif
#endif
}
#endif
"""

PLANE_FRAGMENT = """
#if PLAIN
flat in vec3 v_plain_srgb;
#else
flat in vec3 v_plane_open;
#if RASTER
flat in vec3 v_plane_key;
#endif
#if MATTE
flat in vec3 v_plane_mirror;

vec3 shade_plane(vec3 tint) {
#if RASTER
    vec2 arrives = arriving(1.0);
    UNFUSED vec3 light = tint * (arrives.x * v_plane_open + arrives.y * v_plane_key) + arrives.x * v_plane_mirror;
    return light;
#else
    return tint * v_plane_open + v_plane_mirror;
#endif
}
#else
flat in vec3 v_ambient;
flat in vec3 v_tinted;
flat in vec4 v_gloss;
flat in vec3 v_lobe[LIGHTS];
flat in vec3 v_gain[LIGHTS];
#if RASTER
flat in vec3 v_below;
flat in vec3 v_mirrored_up;
#endif

// `ray`: of unit length, away from the eye; `facing`: its cosine with the plane's normal.
vec3 shade_plane(vec3 tint, vec3 ray, float facing) {
    UNFUSED vec3 mirror = v_gloss.x + v_tinted * tint;
#if RASTER
    vec2 arrives = arriving(v_gloss.w);
    float open = arrives.x, lit = arrives.y, miss_eye = 1.0 - facing;
    mirror += (1.0 - mirror) * (miss_eye * miss_eye * miss_eye * miss_eye * miss_eye * v_gloss.y);
#if SURROUND
    vec3 shine = around_of(ray - 2.0 * dot(v_plane.xyz, ray) * v_plane.xyz) * open;
#else
    vec3 shine = mix(v_below, v_ambient, 0.5 + 0.5 * dot(v_mirrored_up, ray)) * open;
#endif
    vec3 matte = v_plane_open * open + v_plane_key * lit;
#else
    const float open = 1.0, lit = 1.0;
    vec3 shine = v_ambient, matte = v_plane_open;
#endif
    for (int i = 0; i < LIGHTS && DARK == 0; ++i) {
        float lobe = 1.0 / (v_gloss.z + dot(v_lobe[i], ray));
        shine += v_gain[i] * ((i == 0 ? lit : open) * lobe * lobe);
    }
    UNFUSED vec3 light = tint * matte + mirror * shine;
    return light;
}
#endif
#endif
"""
