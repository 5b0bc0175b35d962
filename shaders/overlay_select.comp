#version 430 core
// Copies the Gaussians of a tile that the view shows into a list of marks, ready for one draw call.

#include "overlay.glsl"
#include "records.glsl"

layout(local_size_x = 64) in;

layout(std430, binding = 1) writeonly buffer Marks { Mark marks[]; };
layout(std430, binding = 2) buffer Command { uint vertices, instances, first, base; };

uniform int count;
uniform vec2 base_origin;  // the view's origin, whole source pixels, relative to the tile
uniform vec2 origin;       // what is left of it, in [0, 1)
uniform vec2 scale;        // output pixels per source pixel
uniform vec2 size;         // of the output, pixels
uniform float radius;      // of the ellipse, as sqrt(u^2 + v^2) of gaussian.glsl; 0 for a dot
uniform float margin;      // pixels drawn beyond it

void main()
{
    uint n = gl_GlobalInvocationID.x;
    if (n >= uint(count)) return;
    Record r = record(n + 1u);
    vec2 centre = ((r.mean - base_origin) - origin) * scale;
    // u = a dx + b dy and v = c dy, solved for dx and dy on the circle of this radius
    float c = radius / r.whiten.z * scale.y;
    float a = radius / r.whiten.x * scale.x;
    float b = -r.whiten.y / r.whiten.z * a;
    vec2 reach = vec2(length(vec2(a, b)), c) + margin;
    if (any(lessThan(centre + reach, vec2(0.0))) || any(greaterThan(centre - reach, size))) return;
    uint slot = atomicAdd(instances, 1u);
    marks[slot] = Mark(vec4(centre, a, b), vec4(c, r.peak));
    if (radius > 0.0) atomicMax(vertices, 2u * uint(segments(max(reach.x, reach.y)) + 1));
}
