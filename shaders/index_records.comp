#version 430 core
// Writes the Gaussians as records.glsl reads them, in the order of their places.

#include "index.glsl"

layout(std430, binding = 2) readonly buffer Places { uint places[]; };

#ifdef PACKED
layout(std430, binding = 6) writeonly buffer Records { uvec4 records[]; };

uniform vec3 unpacking;  // see records.glsl

// Rounded to what half floats hold, as drivers may cut off instead.
vec2 halves(vec2 value)
{
    uvec2 bits = floatBitsToUint(value);
    return uintBitsToFloat((bits + 0xfffu + ((bits >> 13) & 1u)) & ~0x1fffu);
}

void write(uint at, vec2 mean, vec3 whiten, vec3 peak)
{
    uvec2 steps = min(uvec2(mean / unpacking.x + 0.5), 0xfffffu);
    uvec3 color = min(uvec3(peak / unpacking.yzy + 0.5), uvec3(0xfffu, 0xffffu, 0xfffu));
    records[at] = uvec4(
        steps | (color.rb << 20),
        packHalf2x16(halves(whiten.xy)),
        packHalf2x16(halves(vec2(whiten.z, 0.0))) | (color.g << 16));
}
#else
layout(std430, binding = 6) writeonly buffer Records { vec4 records[]; };

void write(uint at, vec2 mean, vec3 whiten, vec3 peak)
{
    records[2u * at] = vec4(mean, whiten.xy);
    records[2u * at + 1u] = vec4(whiten.z, peak);
}
#endif

void main()
{
    uint n = gl_GlobalInvocationID.x;
    if (n >= count) return;
    if (n == 0u) write(0u, vec2(0.0), vec3(0.0), vec3(0.0));
    Gaussian g = gaussian(n);
    float across = g.std.x * root(g.rho), along = g.std.y * root(g.rho);
    vec3 whiten = FOLD * vec3(1.0 / across, -g.rho / along, 1.0 / g.std.y);
    write(places[n] + 1u, g.mean - origin(), whiten, g.peak);
}
