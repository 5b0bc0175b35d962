// What the shaders share that index a tile of Gaussians (gsasr/rasterize/gl_index.py, which also
// defines the names in capitals): the Gaussians as they come, and what is found out about them.
//
// The grid of cells starts MARGIN source pixels before the tile's origin and always has GRID cells
// of side 1 along either axis, half as many of side 2 and so on: so nobody need know the bounds of
// the footprints before cells are counted. Only what the tile uses of it gets into its lists.

layout(local_size_x = THREADS) in;

layout(std430, binding = 0) readonly buffer Gaussians { float gaussians[]; };
layout(std430, binding = 1) buffer Found { uint found[]; };  // the greatest of each, or their sum

uniform uint count;       // of the Gaussians
uniform float tolerance;  // see footprint.py
uniform int finest;       // level of the smallest cells: their side is 2^finest source pixels
uniform uint most_boxes;  // more cells than these, of all bounding boxes, are left to the CPU

struct Gaussian {
    vec2 mean;  // source pixels
    vec2 std;
    float rho;
    vec3 peak;
};

Gaussian gaussian(uint n)
{
    uint i = 9u * n;
    vec3 color = vec3(gaussians[i + 5u], gaussians[i + 6u], gaussians[i + 7u]);
    return Gaussian(
        vec2(gaussians[i], gaussians[i + 1u]),
        max(vec2(gaussians[i + 2u], gaussians[i + 3u]), THINNEST),
        gaussians[i + 4u],
        gaussians[i + 8u] * color);
}

// sqrt(1 - rho^2) without cancellation.
float root(float rho) { return sqrt((1.0 - rho) * (1.0 + rho)); }

// The smaller semi-axis of the ellipse q = 1, source pixels (records.py has the formula); in units
// of the larger deviation, as squares of thin ones leave float32.
float narrow(Gaussian g)
{
    float unit = max(g.std.x, g.std.y);
    vec2 std = g.std / unit;
    float determinant = std.x * std.y * root(g.rho);
    determinant *= determinant;
    float middle = 0.5 * dot(std, std);
    float apart = sqrt(max(0.0, middle * middle - determinant));
    return unit * sqrt(determinant / (middle + apart));
}

float highest(Gaussian g) { return max(g.peak.r, max(g.peak.g, g.peak.b)); }

// A number whose order as an integer is the order of floats, and above 0 for all of them.
uint rank(float value)
{
    uint bits = floatBitsToUint(value);
    return (bits >> 31) != 0u ? ~bits : bits | 0x80000000u;
}

float ranked(uint rank)
{
    return uintBitsToFloat((rank >> 31) != 0u ? rank & 0x7fffffffu : ~rank);
}

// Whole source pixels, a multiple of the side of the largest cells: cells of all sides begin there.
vec2 origin()
{
    return floor(vec2(ranked(~found[LEFT]), ranked(~found[TOP])) / COARSEST) * COARSEST;
}

// Draw where q is at most this, or nowhere if it is not positive (footprint.py); a little more than
// on the CPU, so that rounding loses nothing.
float cut(Gaussian g)
{
    float densest = max(1.0, uintBitsToFloat(found[DENSEST]));
    return highest(g) > 0.0 ? 2.0 * log(highest(g) * densest / tolerance) + 1e-4 : -1.0;
}

// Is this a tile for the GPU, as far as is known by now?
bool suits() { return found[UNFIT] == 0u && found[BOXES] <= most_boxes; }

// Where the tables of a level begin, cells.
uint grid_begin(int level)
{
    uint begin = 0u;
    for (int finer = 0; finer < level; ++finer) begin += uint((GRID >> finer) * (GRID >> finer));
    return begin;
}

// Results of a workgroup are put together before they become the tile's: few threads then wait for
// each other. Every thread calls begin_group and end_group.

shared uint found_here[FOUND];

void begin_group()
{
    if (gl_LocalInvocationIndex < FOUND) found_here[gl_LocalInvocationIndex] = 0u;
    barrier();
}

void note(int what, uint value) { atomicMax(found_here[what], value); }

void add(int what, uint value) { atomicAdd(found_here[what], value); }

void end_group()
{
    barrier();
    uint what = gl_LocalInvocationIndex;
    if (what >= FOUND || found_here[what] == 0u) return;
    if (what < SUMS) atomicMax(found[what], found_here[what]);
    else atomicAdd(found[what], found_here[what]);
}
