// The formula, in the common subset of GLSL and CUDA C++ (and host C++): plain floats, no vectors.
//
// Include it after defining, where the language needs it:
//     #define GSASR_FUNCTION __device__ inline     (CUDA; `inline` in C++; nothing in GLSL)
// CUDA and C++ must also see exp2f, fminf and fmaxf (CUDA has them; C++: <cmath>).
//
// A Gaussian is a whitening (a, b, c) of the offset d = x - mean in source pixels,
//     u = a dx + b dy,  v = c dy,   weight = exp(-q/2) = 2^-(u^2 + v^2),
// with a = s / (sx sqrt(1 - rho^2)), b = -s rho / (sy sqrt(1 - rho^2)), c = s / sy and
// s = sqrt(log2(e) / 2). Both terms are squares, so nothing cancels however close |rho| is to 1
// (the conic form a dx^2 + 2 b dx dy + c dy^2 would), and v is constant along a row.

#ifndef GSASR_FUNCTION
#define GSASR_FUNCTION
#endif

#if defined(__cplusplus) || defined(__CUDACC__)
#define GSASR_EXP2 exp2f
#define GSASR_MIN fminf
#define GSASR_MAX fmaxf
#else
#define GSASR_EXP2 exp2
#define GSASR_MIN min
#define GSASR_MAX max
#endif

// exp(-q/2) at offset (dx, dy) from the mean, in (0, 1].
GSASR_FUNCTION float gaussian_weight(float a, float b, float c, float dx, float dy)
{
    float u = a * dx + b * dy;
    float v = c * dy;
    return GSASR_EXP2(-(u * u + v * v));
}

// The least u^2 + v^2 over the rectangle [x0, x1] x [y0, y1] of offsets from the mean.
// A Gaussian reaches a cell when this is at most its cut (s^2 times a cut on q).
GSASR_FUNCTION float gaussian_footprint(
    float a, float b, float c, float x0, float y0, float x1, float y1)
{
    float x = GSASR_MIN(GSASR_MAX(0.0f, x0), x1);  // the point of the rectangle nearest the mean
    float y = GSASR_MIN(GSASR_MAX(0.0f, y0), y1);
    // q is convex, so its minimum lies on an edge that faces the mean: on dy = y or on dx = x.
    float along_x = GSASR_MIN(GSASR_MAX(-b * y / a, x0), x1);
    float along_y = GSASR_MIN(GSASR_MAX(-a * b * x / (b * b + c * c), y0), y1);
    float u = a * along_x + b * y;
    float v = c * y;
    float p = a * x + b * along_y;
    float w = c * along_y;
    return GSASR_MIN(u * u + v * v, p * p + w * w);
}
