// kernels.cu built for a host: one loop in place of the grid, for tests without a GPU.
//
//     c++ -shared -fPIC -O2 -std=c++17 -I FOLDER_OF_KERNELS -I FOLDER_OF_SHADERS host_kernels.cpp

#include <cmath>
#include <cstring>
#include <utility>

#define __global__
#define __device__
using std::ceil;
using std::floor;
using std::fmax;
using std::fmin;

struct Index {
    long long x;
};
static Index blockIdx, threadIdx;
static const Index blockDim = {1};

#include "kernels.cu"

template <class... A, std::size_t... I>
static void run(void (*kernel)(A...), long long threads, void** arguments, std::index_sequence<I...>)
{
    for (blockIdx.x = 0; blockIdx.x < threads; ++blockIdx.x)
        kernel(*static_cast<A*>(arguments[I])...);
}

template <class... A>
static void run(void (*kernel)(A...), long long threads, void** arguments)
{
    run(kernel, threads, arguments, std::index_sequence_for<A...>{});
}

// The arguments are packed as for cuLaunchKernel. Returns 0, or 1 for an unknown kernel.
extern "C" int launch(const char* name, long long threads, void** arguments)
{
    if (!std::strcmp(name, "project")) run(project, threads, arguments);
    else if (!std::strcmp(name, "fill")) run(fill, threads, arguments);
    else if (!std::strcmp(name, "gather")) run(gather, threads, arguments);
    else if (!std::strcmp(name, "backward")) run(backward, threads, arguments);
    else return 1;
    return 0;
}

extern "C" int size_of_picture() { return sizeof(Picture); }
extern "C" int size_of_splat() { return sizeof(Splat); }
