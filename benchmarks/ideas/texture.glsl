// Records come through a texture unit.
layout(binding = 7) uniform usampler2D texels;
uniform vec3 unpacking;

Record record(uint n)
{
    uvec4 p = texelFetch(texels, ivec2(n & 1023u, n >> 10), 0);
    return Record(
        vec2(p.xy & 0xfffffu) * unpacking.x,
        vec3(unpackHalf2x16(p.z), unpackHalf2x16(p.w).x),
        vec3(p.x >> 20, p.w >> 16, p.y >> 20) * unpacking.yzy);
}
