#version 430 core
// Adds one tile of Gaussians to a picture.
//
// A thread owns a block of pixels in one cell of the tile's index, and loads each Gaussian of the
// cell once for all of them. Defined by the program that compiles this:
// ROWS x RUNS threads (rows of pixels in a cell, runs of pixels side by side), PIXELS (even) along
// each of LINES rows per thread, TARGET (the format of the picture).

#include "gaussian.glsl"

layout(local_size_x = ROWS, local_size_y = RUNS) in;

struct Run {       // consecutive pixels along one axis whose centres lie in one cell
    int pixel;     // the first one
    int count;     // at most PIXELS along x, ROWS * LINES along y
    int cell;      // index along this axis in the grid of all the picture
    float offset;  // from the cell's edge to the first pixel's centre, source pixels
};

// Per Gaussian two vec4: mean x, mean y, a, b | c, peak red, green, blue. The means are relative
// to the tile, so they are exact however large the picture.
layout(std430, binding = 0) readonly buffer Records { vec4 records[]; };
// Two lists per cell, row-major: the smooth Gaussians, then the steep ones (see cells.py).
layout(std430, binding = 1) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = 2) readonly buffer Entries { uint entries[]; };
layout(std430, binding = 3) readonly buffer Runs { Run runs[]; };
layout(binding = 0, TARGET) uniform image2D target;

uniform ivec3 window;       // runs to draw: x from [0] below [1], y from [2]
uniform ivec2 grid_first;   // the tile's first cell in the grid of all the picture
uniform vec2 grid_corner;   // where that cell begins, source pixels, relative to the tile
uniform int grid_columns;
uniform float cell_side;    // source pixels
uniform vec2 pixel_size;    // source pixels

const int MIDDLE = PIXELS / 2;  // a run lies round this slot of a line
const float FAR = 120.0;        // keeps 2^x finite for Gaussians too far away to be seen

vec3 sum[LINES * PIXELS];

// base: of the line in `sum`; d: offset of its slot MIDDLE from the mean, source pixels.
void add_smooth(int base, vec4 head, vec4 tail, vec2 d)
{
    // Along a row 2^-(u^2 + v^2) steps by a factor that itself steps by a constant factor.
    float step = head.z * pixel_size.x;
    float u = head.z * d.x + head.w * d.y;
    float v = tail.x * d.y;
    float middle = exp2(-(u * u + v * v));
    float fall = exp2(-2.0 * step * step);
    float right = exp2(clamp(-step * (step + 2.0 * u), -FAR, FAR));
    float left = exp2(clamp(-step * (step - 2.0 * u), -FAR, FAR));
    float weight = middle;
    for (int k = MIDDLE; k < PIXELS; ++k) {
        sum[base + k] += tail.yzw * weight;
        weight *= right;
        right *= fall;
    }
    weight = middle;
    for (int k = MIDDLE - 1; k >= 0; --k) {
        weight *= left;
        left *= fall;
        sum[base + k] += tail.yzw * weight;
    }
}

void add_steep(int base, vec4 head, vec4 tail, vec2 d)
{
    for (int k = 0; k < PIXELS; ++k) {
        float x = d.x + float(k - MIDDLE) * pixel_size.x;
        sum[base + k] += tail.yzw * gaussian_weight(head.z, head.w, tail.x, x, d.y);
    }
}

void main()
{
    int index = window.x + int(gl_WorkGroupID.x) * RUNS + int(gl_LocalInvocationID.y);
    if (index >= window.y) return;
    Run x = runs[index];
    Run y = runs[window.z + int(gl_WorkGroupID.y)];
    int row = int(gl_LocalInvocationID.x);

    ivec2 cell = ivec2(x.cell, y.cell) - grid_first;
    vec2 position = grid_corner + vec2(cell) * cell_side;
    vec2 offset = vec2(x.offset, y.offset) + vec2(x.count / 2, row) * pixel_size;

    for (int k = 0; k < LINES * PIXELS; ++k) sum[k] = vec3(0.0);
    int list = 2 * (cell.y * grid_columns + cell.x);
    uint steep = offsets[list + 1];
    uint end = offsets[list + 2];
    for (uint i = offsets[list]; i < steep; ++i) {
        uint n = 2u * entries[i];
        vec4 head = records[n], tail = records[n + 1u];
        vec2 d = offset - (head.xy - position);
        for (int line = 0; line < LINES; ++line)
            add_smooth(line * PIXELS, head, tail, d + vec2(0.0, float(line * ROWS) * pixel_size.y));
    }
    for (uint i = steep; i < end; ++i) {
        uint n = 2u * entries[i];
        vec4 head = records[n], tail = records[n + 1u];
        vec2 d = offset - (head.xy - position);
        for (int line = 0; line < LINES; ++line)
            add_steep(line * PIXELS, head, tail, d + vec2(0.0, float(line * ROWS) * pixel_size.y));
    }

    for (int line = 0; line < LINES; ++line) {
        int j = row + line * ROWS;
        for (int k = 0; k < PIXELS; ++k) {
            int i = k - MIDDLE + x.count / 2;
            if (i < 0 || i >= x.count || j >= y.count) continue;
            ivec2 at = ivec2(x.pixel + i, y.pixel + j);
            vec3 before = imageLoad(target, at).rgb;
            imageStore(target, at, vec4(before + sum[line * PIXELS + k], 1.0));
        }
    }
}
