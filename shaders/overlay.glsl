// What the overlay shaders share: one marked Gaussian, in output pixels.

struct Mark {
    vec4 place;  // centre x, y; then a, b of the ellipse (x, y) + (a cos t + b sin t, c sin t)
    vec4 look;   // c, and the Gaussian's peak red, green, blue
};

// Chords of an ellipse at this radius (pixels) stay within a tenth of a pixel of it.
int segments(float radius)
{
    return clamp(int(ceil(7.03 * sqrt(radius))), 12, 512);  // pi / sqrt(2 * 0.1) = 7.03
}
