// Tables of the cells of all levels, each level row by row (grid_begin says from where).

// Of cell i entries 2 i and 2 i + 1 are of its ordinary and of its steep Gaussians.
layout(std430, binding = 3) buffer Counts { uint counts[]; };
layout(std430, binding = 4) buffer Starts { uint starts[]; };  // where lists begin, pairs
// The least place of a Gaussian in cell i, inverted, and the greatest; 0 where there is none.
layout(std430, binding = 5) buffer Spans { uint spans[]; };
