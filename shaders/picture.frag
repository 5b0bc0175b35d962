#version 430 core
// The picture as the window shows it: the source below 1:1, the Gaussians above, a blend between,
// the source again where Gaussians have not arrived, and nothing outside of the picture.
//
// WITH_SOURCE, WITH_FIELD, WITH_OVERLAY: what is needed. MAGNIFIED: more than 1:1, and `source` is
// the picture itself.

layout(binding = 0) uniform sampler2D source;  // a mip level: RGBA, sRGB-encoded, not premultiplied
layout(binding = 1) uniform sampler2D field;  // sum of Gaussians for this view
layout(binding = 2) uniform sampler2D coverage;  // 1 where all Gaussians have arrived
layout(binding = 3) uniform sampler2D overlay;  // RGBA of this view, premultiplied
layout(binding = 4) uniform sampler2D coarser;  // the next mip level

uniform ivec2 base;  // the view's origin is base + fraction, source pixels: exact at any zoom
uniform vec2 fraction;
uniform vec2 pixel;  // source pixels per output pixel
uniform ivec2 size;  // of the picture, source pixels
uniform vec2 span;  // source pixels that `source` covers
uniform vec2 coarser_span;
uniform float blend;  // share of the coarser level
uniform float share;  // of the Gaussians, in [0, 1]; the rest is the source
uniform vec2 covered;  // source pixels that the coverage texture spans
uniform bool has_alpha;
uniform vec3 background;

layout(location = 0) out vec4 result;

#ifdef MAGNIFIED
vec4 texel(ivec2 at) { return texelFetch(source, clamp(at, ivec2(0), size - 1), 0); }

vec4 weights(float t)  // Catmull-Rom, for the texels -1, 0, 1, 2
{
    return vec4(
        t * (-0.5 + t * (1.0 - 0.5 * t)), 1.0 + t * t * (1.5 * t - 2.5),
        t * (0.5 + t * (2.0 - 1.5 * t)), t * t * (0.5 * t - 0.5));
}

vec4 from_source(ivec2 at, vec2 inside)
{
    vec2 t = inside - 0.5;
    ivec2 left = at - ivec2(lessThan(t, vec2(0.0)));
    t = fract(t);
    vec4 x = weights(t.x), y = weights(t.y), sum = vec4(0.0);
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) sum += x[i] * y[j] * texel(left + ivec2(i - 1, j - 1));
    return clamp(sum, 0.0, 1.0);
}
#else
vec4 from_source(ivec2 at, vec2 inside)
{
    vec2 position = vec2(at) + inside;
    vec4 color = texture(source, position / span);
    if (blend > 0.0) color = mix(color, texture(coarser, position / coarser_span), blend);
    return color;
}
#endif

vec3 from_field() { return clamp(texelFetch(field, ivec2(gl_FragCoord.xy), 0).rgb, 0.0, 1.0); }

vec3 checkers()
{
    ivec2 tile = ivec2(gl_FragCoord.xy) >> 3;
    return vec3(((tile.x + tile.y) & 1) == 0 ? 0.62 : 0.78);
}

void main()
{
    vec2 offset = fraction + gl_FragCoord.xy * pixel;
    vec2 whole = floor(offset);
    ivec2 at = base + ivec2(whole);
    vec2 inside = offset - whole;
    bool outside = any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size));
#if defined(WITH_SOURCE)
    vec4 color = from_source(at, inside);
#if defined(WITH_FIELD)
    color.rgb = mix(color.rgb, from_field(), share * texture(coverage, (vec2(at) + inside) / covered).r);
#endif
    if (has_alpha) color.rgb = mix(checkers(), color.rgb, color.a);
    vec3 shown = color.rgb;
#else
    vec3 shown = from_field();
#endif
    if (outside) shown = background;
#ifdef WITH_OVERLAY
    vec4 mark = texelFetch(overlay, ivec2(gl_FragCoord.xy), 0);
    shown = mark.rgb + (1.0 - mark.a) * shown;
#endif
    result = vec4(shown, 1.0);
}
