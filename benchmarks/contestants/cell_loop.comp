#version 430 core
// Adds a band of Gaussians to a picture: one pixel per thread, which loops over its cell's list.
//
// GROUP: threads along each side of a workgroup. TARGET: the format of the picture.

#include "gaussian.glsl"

layout(local_size_x = GROUP, local_size_y = GROUP) in;

// Per Gaussian two vec4: mean x, mean y, a, b | c, peak red, green, blue.
layout(std430, binding = 0) readonly buffer Records { vec4 records[]; };
layout(std430, binding = 1) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = 2) readonly buffer Entries { uint entries[]; };
layout(binding = 0, TARGET) uniform image2D target;

uniform ivec2 corner;   // first pixel that the band can reach
uniform ivec2 base;     // the view's origin is base + fraction, source pixels
uniform vec2 fraction;
uniform vec2 pixel;     // source pixels per output pixel
uniform ivec2 first;    // cell of the band's grid, each one source pixel
uniform ivec2 shape;    // of the grid: columns, rows

void main()
{
    ivec2 at = corner + ivec2(gl_GlobalInvocationID.xy);
    vec2 x = fraction + (vec2(at) + 0.5) * pixel;  // relative to base
    ivec2 cell = base - first + ivec2(floor(x));
    if (any(greaterThanEqual(at, imageSize(target)))) return;
    if (any(lessThan(cell, ivec2(0))) || any(greaterThanEqual(cell, shape))) return;
    int list = cell.y * shape.x + cell.x;
    uint end = offsets[list + 1];
    vec3 sum = vec3(0.0);
    for (uint i = offsets[list]; i < end; ++i) {
        uint n = 2u * entries[i];
        vec4 head = records[n], tail = records[n + 1u];
        vec2 d = x - (head.xy - vec2(base));
        sum += tail.yzw * gaussian_weight(head.z, head.w, tail.x, d.x, d.y);
    }
    imageStore(target, at, vec4(imageLoad(target, at).rgb + sum, 1.0));
}
