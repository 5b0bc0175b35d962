#version 430 core
// Makes the counts of all lists lengths in pairs, and finds what there is in all.

#include "index.glsl"
#include "index_tables.glsl"

void main()
{
    uint list = gl_GlobalInvocationID.x;
    begin_group();
    if (list < 2u * grid_begin(LEVELS) && counts[list] > 0u) {
        int level = 0;
        while (list >= 2u * grid_begin(level + 1)) ++level;
        uint pairs = (counts[list] + 1u) / 2u;
        starts[list] = pairs;
        note(LONGEST + level, pairs);
        note(SPAN + level, spans[list | 1u] - ~spans[list & ~1u]);
        add(PAIRS + level, pairs);
        add((list % 2u == 0u ? ORDINARY : STEEP) + level, counts[list]);
    }
    end_group();
}
