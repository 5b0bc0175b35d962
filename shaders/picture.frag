#version 430 core
// The picture as the window shows it: the source below 1:1, the Gaussians above, a blend between,
// the source again where Gaussians have not arrived, and nothing outside of the picture.

layout(binding = 0) uniform sampler2D source;  // RGBA, sRGB-encoded, mip-mapped, not premultiplied
layout(binding = 1) uniform sampler2D field;  // sum of Gaussians for this view
layout(binding = 2) uniform sampler2D coverage;  // 1 where all Gaussians have arrived

uniform ivec2 base;  // the view's origin is base + fraction, source pixels: exact at any zoom
uniform vec2 fraction;
uniform vec2 pixel;  // source pixels per output pixel
uniform ivec2 size;  // of the picture, source pixels
uniform int per_texel;  // output pixels per texel of the field, along each axis
uniform float share;  // of the Gaussians, in [0, 1]; the rest is the source
uniform vec2 covered_size;  // source pixels that the coverage texture spans
uniform bool has_alpha;
uniform vec3 background;

layout(location = 0) out vec4 result;

vec4 texel(ivec2 at) { return texelFetch(source, clamp(at, ivec2(0), size - 1), 0); }

vec4 weights(float t)  // Catmull-Rom, for the texels -1, 0, 1, 2
{
    return vec4(
        t * (-0.5 + t * (1.0 - 0.5 * t)), 1.0 + t * t * (1.5 * t - 2.5),
        t * (0.5 + t * (2.0 - 1.5 * t)), t * t * (0.5 * t - 0.5));
}

vec4 bicubic(ivec2 at, vec2 inside)
{
    vec2 t = inside - 0.5;
    ivec2 left = at - ivec2(lessThan(t, vec2(0.0)));
    t = fract(t);
    vec4 x = weights(t.x), y = weights(t.y), sum = vec4(0.0);
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) sum += x[i] * y[j] * texel(left + ivec2(i - 1, j - 1));
    return clamp(sum, 0.0, 1.0);
}

vec4 from_source(ivec2 at, vec2 inside)
{
    if (max(pixel.x, pixel.y) < 1.0) return bicubic(at, inside);
    vec2 whole = vec2(size);
    return textureGrad(
        source, (vec2(at) + inside) / whole, vec2(pixel.x / whole.x, 0.0), vec2(0.0, pixel.y / whole.y));
}

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
    if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size))) {
        result = vec4(background, 1.0);
        return;
    }
    float amount = share;
    if (amount > 0.0) amount *= texture(coverage, (vec2(at) + inside) / covered_size).r;
    vec4 color = vec4(0.0, 0.0, 0.0, 1.0);
    if (amount < 1.0 || has_alpha) color = from_source(at, inside);
    if (amount > 0.0) {
        vec2 where = gl_FragCoord.xy / float(per_texel);
        vec3 sum = per_texel == 1
            ? texelFetch(field, ivec2(where), 0).rgb
            : texture(field, where / vec2(textureSize(field, 0))).rgb;
        color.rgb = mix(color.rgb, clamp(sum, 0.0, 1.0), amount);
    }
    if (has_alpha) color.rgb = mix(checkers(), color.rgb, color.a);
    result = vec4(color.rgb, 1.0);
}
