#version 430 core
// Counts the Gaussians that meet each cell of one level, or lists them there once they are counted.
//
// Both is this one program, lest a compiler round differently in two. The test is that of cells.py,
// in float32: each cell counts as SLACK larger on all sides, which is more than what rounding adds
// up to in a tile, so that no Gaussian is missing from a cell that it meets.

#include "index.glsl"
#include "index_tables.glsl"

layout(std430, binding = 2) readonly buffer Places { uint places[]; };
layout(std430, binding = 6) buffer Entries { uint entries[]; };  // of this level; of zeros at first

uniform int level;
uniform bool listing;
uniform bool wide;  // entries of 32 bits, else of 16

void visit(uint cell, uint steep, uint place)
{
    uint list = 2u * cell + steep;
    if (!listing) {
        atomicAdd(counts[list], 1u);
        // These only grow: an old value that is read here makes no more than a needless atomic.
        if (spans[2u * cell] < ~place) atomicMax(spans[2u * cell], ~place);
        if (spans[2u * cell + 1u] < place) atomicMax(spans[2u * cell + 1u], place);
        return;
    }
    uint left = atomicAdd(counts[list], 0xffffffffu);
    uint at = 2u * (starts[list] - starts[2u * grid_begin(level)]) + left - 1u;
    uint entry = place - ~spans[2u * cell] + 1u;
    if (wide) entries[at] = entry;
    else atomicOr(entries[at / 2u], entry << (16u * (at % 2u)));
}

void main()
{
    uint n = gl_GlobalInvocationID.x;
    if (n >= count || !suits()) return;
    Gaussian g = gaussian(n);
    float most = cut(g);
    if (most <= 0.0) return;

    float side = float(1 << level), k = sqrt(most);
    uint steep = (STEEP_FROM - k) * narrow(g) * STEEP_SIDE < side ? 1u : 0u;
    int columns = GRID >> level;
    vec2 reach = k * g.std, mean = g.mean - origin() + MARGIN;
    float farthest = g.rho * reach.y, thickness = reach.x * root(g.rho);
    int top = int((mean.y - reach.y - SLACK) / side), bottom = int((mean.y + reach.y + SLACK) / side);
    for (int row = top; row <= bottom; ++row) {
        // What of the ellipse lies between two lines; see _columns in cells.py.
        vec2 lines = vec2(row, row + 1) * side - mean.y + vec2(-SLACK, SLACK);
        lines = clamp(lines, -reach.y, reach.y);
        vec2 t = clamp(lines / reach.y, -1.0, 1.0);
        vec2 halves = thickness * sqrt((1.0 - t) * (1.0 + t)), middles = g.rho * reach.x * t;
        vec2 lefts = middles - halves, rights = middles + halves;
        float left = min(lefts[0], lefts[1]), right = max(rights[0], rights[1]);
        if (lines[0] <= farthest && farthest <= lines[1]) right = reach.x;
        if (lines[0] <= -farthest && -farthest <= lines[1]) left = -reach.x;
        int start = int((mean.x + left - SLACK) / side), stop = int((mean.x + right + SLACK) / side);
        uint line = grid_begin(level) + uint(row * columns);
        for (int column = start; column <= stop; ++column)
            visit(line + uint(column), steep, places[n]);
    }
}
