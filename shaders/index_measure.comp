#version 430 core
// Finds what of a tile does not depend on how far Gaussians reach.

#include "index.glsl"

bool finite(float value) { return (floatBitsToUint(value) & 0x7f800000u) != 0x7f800000u; }

void main()
{
    uint n = gl_GlobalInvocationID.x;
    begin_group();
    if (n < count) {
        bool fit = true;
        for (uint i = 9u * n; i < 9u * n + 9u; ++i) fit = fit && finite(gaussians[i]);
        Gaussian g = gaussian(n);
        if (fit) {
            note(LEFT, ~rank(g.mean.x));
            note(TOP, ~rank(g.mean.y));
            note(RIGHT, rank(g.mean.x));
            note(BOTTOM, rank(g.mean.y));
            note(NARROWEST, ~floatBitsToUint(narrow(g)));
            note(FLATTEST, ~floatBitsToUint(root(g.rho)));
            note(WIDEST, floatBitsToUint(max(g.std.x, g.std.y)));
            note(BRIGHTEST, floatBitsToUint(max(0.0, highest(g))));
        } else {
            note(UNFIT, 1u);
        }
    }
    end_group();
}
