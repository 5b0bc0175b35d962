#version 430 core
// Writes where the lists of one level begin, cell by cell of what the tile uses of the grid.

#include "index.glsl"
#include "index_tables.glsl"

layout(std430, binding = 6) writeonly buffer Lists { uint lists[]; };  // see cells.py

uniform int level;
uniform ivec2 first;  // cell of the grid
uniform ivec2 shape;  // columns and rows

void main()
{
    int i = int(gl_GlobalInvocationID.x), cells = shape.x * shape.y;
    uint begin = grid_begin(level);
    if (i < cells) {
        ivec2 at = first + ivec2(i % shape.x, i / shape.x);
        uint cell = begin + uint(at.y * (GRID >> level) + at.x);
        lists[3 * i] = starts[2u * cell] - starts[2u * begin];
        lists[3 * i + 1] = starts[2u * cell + 1u] - starts[2u * begin];
        lists[3 * i + 2] = spans[2u * cell] == 0u ? 0u : ~spans[2u * cell];
    } else if (i == cells) {
        lists[3 * i] = starts[2u * grid_begin(level + 1)] - starts[2u * begin];
    }
}
