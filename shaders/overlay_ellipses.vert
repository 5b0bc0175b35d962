#version 430 core
// A ribbon along the outline of each marked Gaussian.

#include "overlay.glsl"

in vec4 place;
in vec4 look;
uniform vec2 size;   // of the output, pixels
uniform float reach;  // half the ribbon's width, pixels
out vec2 offset;      // across the ribbon, pixels from the outline
flat out vec3 peak;

void main()
{
    float a = place.z, b = place.w, c = look.x;
    // Vertices beyond this ellipse's own segments repeat the last pair and cover nothing.
    int last = segments(max(length(vec2(a, b)), c) + reach);
    float angle = 6.28318530718 * float(min(gl_VertexID / 2, last)) / float(last);
    vec2 direction = vec2(cos(angle), sin(angle));
    vec2 outline = vec2(a * direction.x + b * direction.y, c * direction.y);
    vec2 tangent = vec2(b * direction.x - a * direction.y, c * direction.x);
    vec2 normal = normalize(vec2(tangent.y, -tangent.x) + 1e-6 * direction);
    float side = (gl_VertexID & 1) == 0 ? 1.0 : -1.0;
    offset = vec2(side * reach, 0.0);
    peak = look.yzw;
    gl_Position = vec4((place.xy + outline + side * reach * normal) / size * 2.0 - 1.0, 0.0, 1.0);
}
