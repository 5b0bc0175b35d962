#version 430 core
// gaussian_footprint of every Gaussian in every cell of side 1.

#include "gaussian.glsl"

layout(local_size_x = 1) in;
layout(std430, binding = 0) readonly buffer Gaussians { float gaussians[]; };  // mean xy, a b c
layout(std430, binding = 1) writeonly buffer Least { float least[]; };
uniform ivec2 first;

void main()
{
    uvec3 id = gl_GlobalInvocationID;
    uint n = 5u * id.z;
    vec2 low = vec2(first + ivec2(id.xy)) - vec2(gaussians[n], gaussians[n + 1u]);
    least[(id.z * gl_NumWorkGroups.y + id.y) * gl_NumWorkGroups.x + id.x] = gaussian_footprint(
        gaussians[n + 2u], gaussians[n + 3u], gaussians[n + 4u],
        low.x, low.y, low.x + 1.0, low.y + 1.0);
}
