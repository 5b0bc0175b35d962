#version 430 core
// Adds one tile of Gaussians to a picture.
//
// A thread owns a block of BLOCK x BLOCK pixels inside one cell of the tile's index, and loads each
// Gaussian of the cell once for all of them. Defined by the program that compiles this: BLOCK,
// THREADS_X x THREADS_Y, TARGET (the format of the picture), PACKED (see records.glsl), WIDE
// (entries of 32 bits), STEEP (evaluate Gaussians at every pixel instead of following them).

#include "gaussian.glsl"
#include "records.glsl"

layout(local_size_x = THREADS_X, local_size_y = THREADS_Y) in;

struct Run {       // consecutive pixels along one axis whose centres lie in one cell
    int pixel;     // the first one
    int count;     // at most BLOCK
    int cell;      // index along this axis in the grid of all the picture
    float offset;  // from the cell's edge to the centre of pixel count / 2, source pixels
};

layout(std430, binding = 1) readonly buffer Lists { uint lists[]; };    // see cells.py
layout(std430, binding = 2) readonly buffer Entries { uint entries[]; };
layout(std430, binding = 3) readonly buffer Runs { Run runs[]; };
layout(binding = 0, TARGET) uniform image2D target;

uniform ivec4 window;       // runs to draw: x from [0] below [1], y from [2] below [3]
uniform ivec2 grid_first;   // the tile's first cell in the grid of all the picture
uniform vec2 grid_corner;   // where that cell begins, source pixels, relative to the tile
uniform int grid_columns;
uniform float cell_side;    // source pixels
uniform vec2 pixel_size;    // source pixels
uniform ivec2 part;         // where lists of a cell begin and end: ordinary (0, 1), steep (1, 3)
uniform uvec2 portion;      // of every list the pairs from [0] below [1]: drivers end long loops

const int MIDDLE = BLOCK / 2;  // a run lies round this slot of a block

// Sums stay in registers only if every index is known to the compiler, and compilers do not unroll
// loops of this size: so all slots of the largest block are written out, and those of none vanish.
#define ROW(SLOT, j) \
    SLOT(j, 0) SLOT(j, 1) SLOT(j, 2) SLOT(j, 3) SLOT(j, 4) \
    SLOT(j, 5) SLOT(j, 6) SLOT(j, 7) SLOT(j, 8) SLOT(j, 9)
#define ALL(SLOT) \
    ROW(SLOT, 0) ROW(SLOT, 1) ROW(SLOT, 2) ROW(SLOT, 3) ROW(SLOT, 4) \
    ROW(SLOT, 5) ROW(SLOT, 6) ROW(SLOT, 7) ROW(SLOT, 8) ROW(SLOT, 9)

const int SLOTS = 10;  // along a side of the largest block
vec3 sum[SLOTS * SLOTS];

#ifdef STEEP
#define EVALUATE(j, i) if (j < BLOCK && i < BLOCK) { \
    vec2 at = d + vec2(i - MIDDLE, j - MIDDLE) * pixel_size; \
    sum[SLOTS * j + i] += peak * gaussian_weight(whiten.x, whiten.y, whiten.z, at.x, at.y); }

// d: offset of the block's middle slot from the mean, source pixels.
void add(vec3 whiten, vec3 peak, vec2 d)
{
    ALL(EVALUATE)
}
#else
#define RIGHT(k) if (MIDDLE + k < BLOCK) { \
    sum[SLOTS * row + MIDDLE + k] += color; color *= along; along *= fall; }
#define LEFT(k) if (MIDDLE - k >= 0) { \
    color *= back; back *= fall; sum[SLOTS * row + MIDDLE - k] += color; }

// Along a line of pixels 2^-(u^2 + v^2) steps by a factor that itself steps by a constant factor,
// so from the middle slot all others follow by multiplications: nine exponentials for a block.
// along, back: that factor to the right and to the left of the middle slot.
void add_row(int row, vec3 middle, float along, float back, float fall)
{
    vec3 color = middle;
    RIGHT(0) RIGHT(1) RIGHT(2) RIGHT(3) RIGHT(4)
    color = middle;
    LEFT(1) LEFT(2) LEFT(3) LEFT(4) LEFT(5)
}

#define BELOW(k) if (MIDDLE + k < BLOCK) { \
    add_row(MIDDLE + k, color, a, b, fall); \
    color *= below; below *= sink; a *= twist; b *= untwist; }
#define ABOVE(k) if (MIDDLE - k >= 0) { \
    color *= above; above *= sink; a *= untwist; b *= twist; \
    add_row(MIDDLE - k, color, a, b, fall); }

// d: offset of the block's middle slot from the mean, source pixels.
void add(vec3 whiten, vec3 peak, vec2 d)
{
    // A step to the right adds `right` to u; one down adds `down` to (u, v).
    float right = whiten.x * pixel_size.x;
    vec2 down = whiten.yz * pixel_size.y;
    vec2 uv = vec2(whiten.x * d.x + whiten.y * d.y, whiten.z * d.y);
    vec3 middle = peak * exp2(-dot(uv, uv));
    float along = exp2(-right * (right + 2.0 * uv.x)), back = exp2(-right * (right - 2.0 * uv.x));
    float below = exp2(-dot(down, down + 2.0 * uv)), above = exp2(-dot(down, down - 2.0 * uv));
    float fall = exp2(-2.0 * right * right), sink = exp2(-2.0 * dot(down, down));
    float twist = exp2(-2.0 * right * down.x), untwist = exp2(2.0 * right * down.x);

    vec3 color = middle;
    float a = along, b = back;
    BELOW(0) BELOW(1) BELOW(2) BELOW(3) BELOW(4)
    color = middle, a = along, b = back;
    ABOVE(1) ABOVE(2) ABOVE(3) ABOVE(4) ABOVE(5)
}
#endif

// position: of the cell, relative to the tile; offset: of the middle slot, relative to the cell. In
// this order the difference is exact at any zoom.
void add_entry(uint base, uint entry, vec2 position, vec2 offset)
{
    Record r = record(entry == 0u ? 0u : base + entry);
    add(r.whiten, r.peak, offset - (r.mean - position));
}

#define CLEAR(j, i) if (j < BLOCK && i < BLOCK) sum[SLOTS * j + i] = vec3(0.0);
#define STORE(j, i) if (j < BLOCK && i < BLOCK) store(ivec2(i, j) + shift, x, y, sum[SLOTS * j + i]);

void store(ivec2 inside, Run x, Run y, vec3 more)
{
    if (any(lessThan(inside, ivec2(0))) || inside.x >= x.count || inside.y >= y.count) return;
    ivec2 at = ivec2(x.pixel, y.pixel) + inside;
    imageStore(target, at, vec4(imageLoad(target, at).rgb + more, 1.0));
}

void main()
{
    int column = window[0] + int(gl_GlobalInvocationID.x);
    int line = window[2] + int(gl_GlobalInvocationID.y);
    if (column >= window[1] || line >= window[3]) return;
    Run x = runs[column], y = runs[line];
    ivec2 cell = ivec2(x.cell, y.cell) - grid_first;
    vec2 position = grid_corner + vec2(cell) * cell_side;
    vec2 offset = vec2(x.offset, y.offset);

    ALL(CLEAR)
    int list = 3 * (cell.y * grid_columns + cell.x);
    uint start = lists[list + part[0]], end = lists[list + part[1]];
    if (start == end) return;
    uint base = lists[list + 2];
    end = min(end, start + portion[1]);
    for (uint pair = start + portion[0]; pair < end; ++pair) {
#ifdef WIDE
        uint first = entries[2u * pair], second = entries[2u * pair + 1u];
#else
        uint both = entries[pair], first = both & 0xffffu, second = both >> 16;
#endif
        add_entry(base, first, position, offset);
        add_entry(base, second, position, offset);
    }

    ivec2 shift = ivec2(x.count, y.count) / 2 - MIDDLE;
    ALL(STORE)
}
