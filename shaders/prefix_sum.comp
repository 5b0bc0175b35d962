#version 430 core
// Exclusive prefix sums, in place, of BLOCK values by each workgroup; their sum goes to `sums`.
// CARRY: adds to all values of a block what came before it, once `sums` are prefix sums too.

layout(local_size_x = THREADS) in;
layout(std430, binding = 0) buffer Values { uint values[]; };
layout(std430, binding = 1) buffer Sums { uint sums[]; };

uniform uint count;

const uint EACH = BLOCK / THREADS;  // values of a thread

#ifdef CARRY
void main()
{
    uint first = gl_WorkGroupID.x * BLOCK + gl_LocalInvocationIndex;
    for (uint i = first; i < min(first + BLOCK, count); i += THREADS)
        values[i] += sums[gl_WorkGroupID.x];
}
#else
shared uint upto[THREADS];  // the sum of what this thread and those before it hold

void main()
{
    uint me = gl_LocalInvocationIndex, first = EACH * gl_GlobalInvocationID.x;
    uint before[EACH], sum = 0u;
    for (uint i = 0u; i < EACH; ++i) {
        before[i] = sum;
        if (first + i < count) sum += values[first + i];
    }
    upto[me] = sum;
    barrier();
    for (uint reach = 1u; reach < THREADS; reach *= 2u) {
        uint other = me >= reach ? upto[me - reach] : 0u;
        barrier();
        upto[me] += other;
        barrier();
    }
    for (uint i = 0u; i < EACH; ++i)
        if (first + i < count) values[first + i] = upto[me] - sum + before[i];
    if (me == THREADS - 1u) sums[gl_WorkGroupID.x] = upto[me];
}
#endif
