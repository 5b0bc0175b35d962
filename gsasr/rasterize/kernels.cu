// The rasterizer in CUDA C++, compiled at run time (see nvrtc.py) and launched by cuda.py.
//
//     project    one thread per Gaussian: into output pixels; how many tiles it reaches
//     fill       one thread per Gaussian: those tiles, as (tile, Gaussian) entries
//     gather     one thread per strip of pixels: adds up the Gaussians of its tile, in their order
//     backward   one thread per Gaussian: gradients, summed over the pixels of its ellipse
//
// Every output value has one writer and one order of additions, so results are equal to the bit
// from run to run. No kernel uses barriers, shared memory or atomics: any C++ compiler can build
// them for a host too, which is how they are tested without a GPU.
//
// A batch holds several pictures of any sizes. Their Gaussians, tiles and pixels follow one
// another; `pictures` says where each one's begin.

#define GSASR_FUNCTION __device__ inline
#include "gaussian.glsl"

#define STRIP 4  // pixels along a row that one thread of `gather` computes

struct Picture {
    double origin_x, origin_y;  // of its view, source pixels
    double scale_x, scale_y;    // output pixels per source pixel
    long long gaussian;         // its first Gaussian
    long long tile;             // its first tile
    long long pixel;            // its first pixel
    int width, height;          // output pixels
    int across, down;           // tiles
};

// A Gaussian in output pixels. Its centre is whole + part, where whole is an integer: offsets of
// pixels stay exact however far from the picture's corner.
struct alignas(16) Splat {
    float whole_x, whole_y, part_x, part_y;
    float a, b, c, limit;  // whitening; drawn where u^2 + v^2 <= limit, nowhere if negative
    float red, green, blue, unused;
};

struct Range {
    int first, last;  // both included; empty if last < first
};

#define THREAD ((long long)blockIdx.x * blockDim.x + threadIdx.x)
#define SQRT_HALF_LOG2E 0.84932180028801904f  // s of gaussian.glsl
#define SQRT_2_LN2 1.17741002251547469f       // 1 / s

// The last of `count` pictures whose first Gaussian or tile (`start`) is at most n. One without any
// shares its number with the next one, which wins.
__device__ inline int picture_of(
    const Picture* pictures, int count, long long Picture::*start, long long n)
{
    int low = 0;
    for (int high = count; high - low > 1;) {
        int middle = (low + high) / 2;
        if (pictures[middle].*start <= n) low = middle;
        else high = middle;
    }
    return low;
}

// Integers i in [0, size) with low <= i - whole <= high.
__device__ inline Range pixels_between(float whole, float low, float high, int size)
{
    Range range;
    range.first = (int)fmin(fmax((double)whole + ceilf(low), 0.0), (double)size);
    range.last = (int)fmin(fmax((double)whole + floorf(high), -1.0), size - 1.0);
    return range;
}

// Rows that the ellipse reaches.
__device__ inline Range rows_of(const Splat& splat, int height)
{
    float reach = sqrtf(splat.limit) / splat.c;
    return pixels_between(splat.whole_y, splat.part_y - reach, splat.part_y + reach, height);
}

// Columns that the ellipse reaches in any row.
__device__ inline Range columns_of(const Splat& splat, int width)
{
    float slant = splat.b / splat.c;
    float reach = sqrtf(splat.limit * (1.0f + slant * slant)) / splat.a;
    return pixels_between(splat.whole_x, splat.part_x - reach, splat.part_x + reach, width);
}

// Whether any pixel of the tile (column i, row j) lies in the ellipse.
__device__ inline bool reaches(const Splat& splat, int tile, int i, int j)
{
    float x = ((float)(i * tile) - splat.whole_x) - splat.part_x;
    float y = ((float)(j * tile) - splat.whole_y) - splat.part_y;
    float side = (float)(tile - 1);
    return gaussian_footprint(splat.a, splat.b, splat.c, x, y, x + side, y + side) <= splat.limit;
}

extern "C" __global__ void project(
    long long count,
    const float* mean,         // [count, 2] source pixels
    const float* std,          // [count, 2] source pixels
    const float* rho,          // [count]
    const float* peak,         // [count, 3] opacity * colour
    const float* cut,          // [count] drawn where q <= cut, nowhere if negative
    const Picture* pictures,   // [picture_count]
    int picture_count,
    int tile,                  // side, pixels
    Splat* splats,             // [count] out
    int* tiles)                // [count] out: how many tiles each one reaches
{
    long long n = THREAD;
    if (n >= count) return;
    const Picture& picture = pictures[picture_of(pictures, picture_count, &Picture::gaussian, n)];
    double x = ((double)mean[2 * n] - picture.origin_x) * picture.scale_x - 0.5;
    double y = ((double)mean[2 * n + 1] - picture.origin_y) * picture.scale_y - 0.5;
    float std_x = (float)(std[2 * n] * picture.scale_x);
    float std_y = (float)(std[2 * n + 1] * picture.scale_y);
    float root = sqrtf((1.0f - rho[n]) * (1.0f + rho[n]));
    Splat splat;
    splat.whole_x = (float)floor(x);
    splat.whole_y = (float)floor(y);
    splat.part_x = (float)(x - splat.whole_x);
    splat.part_y = (float)(y - splat.whole_y);
    splat.a = SQRT_HALF_LOG2E / (std_x * root);
    splat.b = -SQRT_HALF_LOG2E * rho[n] / (std_y * root);
    splat.c = SQRT_HALF_LOG2E / std_y;
    splat.limit = cut[n] * (SQRT_HALF_LOG2E * SQRT_HALF_LOG2E);
    splat.red = peak[3 * n];
    splat.green = peak[3 * n + 1];
    splat.blue = peak[3 * n + 2];
    splat.unused = 0.0f;

    int reached = 0;
    float shape = splat.part_x + splat.part_y + splat.a + splat.b + splat.c;
    if (splat.limit >= 0.0f && shape - shape == 0.0f) {  // false for NaN and infinities
        Range rows = rows_of(splat, picture.height);
        Range columns = columns_of(splat, picture.width);
        if (rows.first <= rows.last && columns.first <= columns.last)
            for (int j = rows.first / tile; j <= rows.last / tile; ++j)
                for (int i = columns.first / tile; i <= columns.last / tile; ++i)
                    reached += reaches(splat, tile, i, j);
    }
    if (!reached) splat.limit = -1.0f;
    splats[n] = splat;
    tiles[n] = reached;
}

extern "C" __global__ void fill(
    long long start, long long stop,  // Gaussians
    const Splat* splats,              // [stop...]
    const long long* ends,            // [stop...] running sum of project's `tiles`
    const Picture* pictures, int picture_count, int tile,
    int* keys,                        // [entries] out: tile of each entry
    int* owners)                      // [entries] out: Gaussian of each entry
{
    long long n = start + THREAD;
    if (n >= stop || splats[n].limit < 0.0f) return;
    Splat splat = splats[n];
    const Picture& picture = pictures[picture_of(pictures, picture_count, &Picture::gaussian, n)];
    Range rows = rows_of(splat, picture.height);
    Range columns = columns_of(splat, picture.width);
    long long entry = (n ? ends[n - 1] : 0) - (start ? ends[start - 1] : 0);
    for (int j = rows.first / tile; j <= rows.last / tile; ++j)
        for (int i = columns.first / tile; i <= columns.last / tile; ++i)
            if (reaches(splat, tile, i, j)) {
                keys[entry] = (int)(picture.tile + (long long)j * picture.across + i);
                owners[entry++] = (int)n;
            }
}

extern "C" __global__ void gather(
    long long strips,        // of all tiles
    const Splat* splats,
    const int* owners,       // [entries] Gaussians, sorted by tile
    const long long* first,  // [tiles + 1] first entry of each tile
    const Picture* pictures, int picture_count, int tile,
    float* pixels)           // [pixels, 3], added to
{
    long long strip = THREAD;
    if (strip >= strips) return;
    int across = tile / STRIP;
    long long cell = strip / (across * tile);
    int inside = (int)(strip % (across * tile));
    if (first[cell] == first[cell + 1]) return;
    const Picture& picture = pictures[picture_of(pictures, picture_count, &Picture::tile, cell)];
    int local = (int)(cell - picture.tile);
    int x = local % picture.across * tile + inside % across * STRIP;
    int y = local / picture.across * tile + inside / across;
    if (x >= picture.width || y >= picture.height) return;

    float red[STRIP] = {}, green[STRIP] = {}, blue[STRIP] = {};
    for (long long entry = first[cell]; entry < first[cell + 1]; ++entry) {
        const Splat splat = splats[owners[entry]];
        float dx = ((float)x - splat.whole_x) - splat.part_x;
        float dy = ((float)y - splat.whole_y) - splat.part_y;
#pragma unroll
        for (int i = 0; i < STRIP; ++i) {
            float weight = gaussian_weight(splat.a, splat.b, splat.c, dx + (float)i, dy);
            red[i] += weight * splat.red;
            green[i] += weight * splat.green;
            blue[i] += weight * splat.blue;
        }
    }
    float* out = pixels + 3 * (picture.pixel + (long long)y * picture.width + x);
#pragma unroll
    for (int i = 0; i < STRIP; ++i)
        if (x + i < picture.width) {
            out[3 * i] += red[i];
            out[3 * i + 1] += green[i];
            out[3 * i + 2] += blue[i];
        }
}

// With e = (dx / std_x - rho t) / sqrt(1 - rho^2) and t = dy / std_y, q = e^2 + t^2; every
// derivative of q is linear in e, t, e^2, e t, t^2, so eight weighted sums hold all there is.
// u and v of gaussian.glsl are s e and s t.
extern "C" __global__ void backward(
    long long count,
    const Splat* splats,      // [count]
    const float* std,         // [count, 2] source pixels
    const float* rho,         // [count]
    const Picture* pictures, int picture_count,
    const float* upstream,    // [pixels, 3] gradient of each output value
    float* grads)             // [count, 8] out: mean 2, std 2, rho, peak 3
{
    long long n = THREAD;
    if (n >= count) return;
    float* out = grads + 8 * n;
    Splat splat = splats[n];
    if (splat.limit < 0.0f) {
        for (int i = 0; i < 8; ++i) out[i] = 0.0f;
        return;
    }
    const Picture& picture = pictures[picture_of(pictures, picture_count, &Picture::gaussian, n)];
    float red = 0.0f, green = 0.0f, blue = 0.0f;
    float sum_u = 0.0f, sum_v = 0.0f, sum_uu = 0.0f, sum_uv = 0.0f, sum_vv = 0.0f;
    Range rows = rows_of(splat, picture.height);
    for (int y = rows.first; y <= rows.last; ++y) {
        float dy = ((float)y - splat.whole_y) - splat.part_y;
        float v = splat.c * dy;
        float remaining = splat.limit - v * v;
        if (remaining < 0.0f) continue;
        float center = splat.part_x - splat.b * dy / splat.a;
        float reach = sqrtf(remaining) / splat.a;
        Range row =
            pixels_between(splat.whole_x, center - reach, center + reach, picture.width);
        const float* up = upstream + 3 * (picture.pixel + (long long)y * picture.width);
        float row_sum = 0.0f, row_u = 0.0f, row_uu = 0.0f;
        for (int x = row.first; x <= row.last; ++x) {
            float dx = ((float)x - splat.whole_x) - splat.part_x;
            float weight = gaussian_weight(splat.a, splat.b, splat.c, dx, dy);
            float u = splat.a * dx + splat.b * dy;
            float r = up[3 * x], g = up[3 * x + 1], b = up[3 * x + 2];
            red += weight * r;
            green += weight * g;
            blue += weight * b;
            float h = weight * (splat.red * r + splat.green * g + splat.blue * b);
            row_sum += h;
            row_u += h * u;
            row_uu += h * u * u;
        }
        sum_u += row_u;
        sum_uu += row_uu;
        sum_v += row_sum * v;
        sum_uv += row_u * v;
        sum_vv += row_sum * v * v;
    }
    float root = sqrtf((1.0f - rho[n]) * (1.0f + rho[n]));
    float tilt = rho[n] / root;
    float e = SQRT_2_LN2 * sum_u, t = SQRT_2_LN2 * sum_v;
    float ee = SQRT_2_LN2 * SQRT_2_LN2 * sum_uu;
    float et = SQRT_2_LN2 * SQRT_2_LN2 * sum_uv;
    float tt = SQRT_2_LN2 * SQRT_2_LN2 * sum_vv;
    out[0] = e / (std[2 * n] * root);
    out[1] = (t - tilt * e) / std[2 * n + 1];
    out[2] = (ee + tilt * et) / std[2 * n];
    out[3] = (tt - tilt * et) / std[2 * n + 1];
    out[4] = (et - tilt * ee) / root;
    out[5] = red;
    out[6] = green;
    out[7] = blue;
}
