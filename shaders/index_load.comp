#version 430 core
// Counts the Gaussians in each source pixel, and adds up their areas (footprint.py says what for).

#include "index.glsl"
#include "index_pixels.glsl"

// Sums of areas in 256ths of a pixel: 64 bits, the low half first.
layout(std430, binding = 4) buffer Loads { uint loads[]; };

const float TWO_PI = 6.2831853;

void main()
{
    uint n = gl_GlobalInvocationID.x;
    if (n >= count || found[UNFIT] != 0u) return;
    Gaussian g = gaussian(n);
    float area = TWO_PI * g.std.x * g.std.y * root(g.rho);
    if (any(greaterThanEqual(g.mean - origin(), vec2(PIXELS))) || area > LARGEST) {
        atomicMax(found[UNFIT], 1u);
        return;
    }
    uint at = pixel(g);
    atomicAdd(heads[at], 1u);
    uint more = uint(ceil(256.0 * max(1.0, area)));
    uint before = atomicAdd(loads[2u * at], more);
    if (before + more < before) atomicAdd(loads[2u * at + 1u], 1u);
}
