// CUDA kernels built for a host: one loop in place of the grid, for tests without a GPU.
// It runs kernels without barriers and shared memory, one thread after another, which makes every
// addition atomic; host_kernels.py completes it.

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

inline void atomicAdd(float* address, float value) { *address += value; }

template <class... A, std::size_t... I>
static void run(void (*kernel)(A...), long long threads, void** arguments, std::index_sequence<I...>)
{
    for (blockIdx.x = 0; blockIdx.x < threads; ++blockIdx.x)
        kernel(*static_cast<A*>(arguments[I])...);
}

// The arguments are packed as for cuLaunchKernel.
template <class... A>
static void run(void (*kernel)(A...), long long threads, void** arguments)
{
    run(kernel, threads, arguments, std::index_sequence_for<A...>{});
}
