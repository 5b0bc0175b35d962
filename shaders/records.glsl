// How a Gaussian is kept on the GPU (see gsasr/rasterize/records.py), and how it is read.
// PACKED: 16 bytes, else 32. Record 0 is of no Gaussian: it adds nothing anywhere.

struct Record {
    vec2 mean;    // source pixels, relative to the tile: exact however large the picture
    vec3 whiten;  // a, b, c of gaussian.glsl
    vec3 peak;    // opacity * color
};

#ifdef PACKED
layout(std430, binding = 0) readonly buffer Records { uvec4 records[]; };
uniform vec3 unpacking;  // source pixels per step of a mean; colour per 4095th, 65535th of a peak

Record record(uint n)
{
    uvec4 p = records[n];
    return Record(
        vec2(p.xy & 0xfffffu) * unpacking.x,
        vec3(unpackHalf2x16(p.z), unpackHalf2x16(p.w).x),
        vec3(p.x >> 20, p.w >> 16, p.y >> 20) * unpacking.yzy);
}
#else
layout(std430, binding = 0) readonly buffer Records { vec4 records[]; };

Record record(uint n)
{
    vec4 head = records[2u * n], tail = records[2u * n + 1u];
    return Record(head.xy, vec3(head.zw, tail.x), tail.yzw);
}
#endif
