#version 430 core
// Finds the densest source pixel.

#include "index.glsl"

layout(std430, binding = 4) readonly buffer Loads { uint loads[]; };

void main()
{
    uint at = gl_GlobalInvocationID.x;
    begin_group();
    if (at < PIXELS * PIXELS) {
        float load = (float(loads[2u * at + 1u]) * 4294967296.0 + float(loads[2u * at])) / 256.0;
        note(DENSEST, floatBitsToUint(load));
    }
    end_group();
}
