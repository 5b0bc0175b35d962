#version 430 core
// Makes a buffer all zeros.

layout(local_size_x = THREADS) in;
layout(std430, binding = 0) writeonly buffer Values { uint values[]; };

uniform uint count;

void main()
{
    uint step = gl_NumWorkGroups.x * THREADS;
    for (uint i = gl_GlobalInvocationID.x; i < count; i += step) values[i] = 0u;
}
