"""GLSL of planar faces of one material: what of their light is the same everywhere is found once a face, in its last vertex.

The light is that of the general `shade` of each tier, written in other terms. A plane mirrors a light instead of every ray, so
that the cosine between a mirrored ray and a light is that between the ray and the mirrored light.

`UNFUSED` keeps a GPU from fusing a product with a sum, which it would do in other places without a texture than with a white
one: a pass that is forced must change no byte. llvmpipe fuses nothing, and the word would cost it 2 % of the time of drawing.
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
flat out vec4 v_gloss;             // untinted part of it, 1 - roughness, offset of the lobes, cosine of the key light
flat out vec3 v_lobe[LIGHTS];      // mirrored lights, scaled to the lobe
flat out vec3 v_gain[LIGHTS];
#if RASTER
flat out vec3 v_below;
flat out vec3 v_mirrored_up;
#endif
#endif

void light_plane() {
    vec3 normal = v_plane.w > 0.0 ? -v_plane.xyz : v_plane.xyz;    // towards the eye
#if RASTER
    vec3 around = mix(below, ambient, 0.5 + 0.5 * dot(normal, up));
#else
    vec3 around = ambient;
#endif
    vec3 diffuse = albedo_roughness.rgb * (1.0 - normal_metallic.w), mirror = 0.04 * around;
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
    v_gloss = vec4(0.04 * (1.0 - metallic), 1.0 - roughness, 0.5 + 0.5 / width, dot(normal, light_towards[0]));
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
    vec3 shine = mix(v_below, v_ambient, 0.5 + 0.5 * dot(v_mirrored_up, ray)) * open;
    vec3 matte = v_plane_open * open + v_plane_key * lit;
#else
    const float open = 1.0, lit = 1.0;
    vec3 shine = v_ambient, matte = v_plane_open;
#endif
    for (int i = 0; i < LIGHTS; ++i) {
        float lobe = 1.0 / (v_gloss.z + dot(v_lobe[i], ray));
        shine += v_gain[i] * ((i == 0 ? lit : open) * lobe * lobe);
    }
    UNFUSED vec3 light = tint * matte + mirror * shine;
    return light;
}
#endif
#endif
"""
