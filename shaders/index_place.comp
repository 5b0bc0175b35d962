#version 430 core
// Gives every Gaussian its place in the order of source pixels, and finds how far they reach.

#include "index.glsl"
#include "index_pixels.glsl"

layout(std430, binding = 2) writeonly buffer Places { uint places[]; };

// `heads` holds the next free place of each pixel.
void main()
{
    uint n = gl_GlobalInvocationID.x;
    begin_group();
    if (n < count && found[UNFIT] == 0u) {
        Gaussian g = gaussian(n);
        places[n] = atomicAdd(heads[pixel(g)], 1u);
        float most = cut(g);
        if (most > 0.0) {
            vec2 reach = sqrt(most) * g.std + 2.0 * SLACK;  // one more: this is another program
            if (any(greaterThan(reach, vec2(REACH)))) {
                note(UNFIT, 1u);
            } else {
                vec2 at = g.mean - origin() + MARGIN;
                uvec2 low = uvec2(at - reach), high = uvec2(at + reach);
                note(FIRST_COLUMN, ~low.x);
                note(FIRST_ROW, ~low.y);
                note(LAST_COLUMN, high.x);
                note(LAST_ROW, high.y);
                uvec2 box = (high >> finest) - (low >> finest) + 1u;
                add(BOXES, (box.x * box.y + 7u) / 8u);
            }
        }
    }
    end_group();
}
