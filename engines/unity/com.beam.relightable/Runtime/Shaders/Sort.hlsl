// Splats in order, farthest first: a stable radix sort of four bits a pass, without wave intrinsics. A thread of Count and
// Scatter takes RUN numbers that follow each other; counts are digit by digit, and of a digit group by group.

static const uint THREADS = 64;
static const uint RUN = 16;
static const uint DIGITS = 16;
static const uint SCANNERS = 256;

#include "Gaussians.hlsl"

StructuredBuffer<uint2> _BeamUnsorted; // key, number of the Gaussian
RWStructuredBuffer<uint2> _BeamSorted;
RWStructuredBuffer<uint> _BeamDigits;
RWStructuredBuffer<uint> _BeamOrdered;
float4 _BeamSort; // items, groups, shift of the digit
float4 _BeamSortPlane; // position, and the way along which depth is counted
float4 _BeamSortWay;

groupshared uint counts[1024]; // DIGITS x THREADS
groupshared uint sums[SCANNERS];

[numthreads(64, 1, 1)]
void Keys(uint3 thread : SV_DispatchThreadID)
{
    if (thread.x >= uint(_BeamSort.x))
        return;
    float3 position = mul(_BeamObject, float4(_BeamGaussians[ROWS * thread.x].xyz, 1.0)).xyz;
    uint bits = asuint(dot(position - _BeamSortPlane.xyz, _BeamSortWay.xyz));
    // of floats with the sign turned, unsigned integers have the order; inverted: the farthest first
    bits = ~(bits & 0x80000000u ? ~bits : bits | 0x80000000u);
    _BeamSorted[thread.x] = uint2(bits, thread.x);
}

uint digitOf(uint key)
{
    return (key >> uint(_BeamSort.z)) & (DIGITS - 1u);
}

void countRun(uint group, uint thread)
{
    for (uint digit = 0u; digit < DIGITS; digit++)
        counts[digit * THREADS + thread] = 0u;
    uint first = (group * THREADS + thread) * RUN;
    for (uint i = first; i < min(first + RUN, uint(_BeamSort.x)); i++)
        counts[digitOf(_BeamUnsorted[i].x) * THREADS + thread]++;
    GroupMemoryBarrierWithGroupSync();
}

[numthreads(64, 1, 1)]
void Count(uint3 group : SV_GroupID, uint3 thread : SV_GroupThreadID)
{
    countRun(group.x, thread.x);
    if (thread.x >= DIGITS)
        return;
    uint total = 0u;
    for (uint t = 0u; t < THREADS; t++)
        total += counts[thread.x * THREADS + t];
    _BeamDigits[thread.x * uint(_BeamSort.y) + group.x] = total;
}

/// Sums before each of all counts; one group.
[numthreads(256, 1, 1)]
void Scan(uint3 thread : SV_GroupThreadID)
{
    uint all = DIGITS * uint(_BeamSort.y);
    uint share = (all + SCANNERS - 1u) / SCANNERS;
    uint first = min(thread.x * share, all);
    uint end = min(first + share, all);
    uint total = 0u;
    for (uint i = first; i < end; i++)
        total += _BeamDigits[i];
    sums[thread.x] = total;
    GroupMemoryBarrierWithGroupSync();
    uint before = 0u;
    for (uint t = 0u; t < thread.x; t++)
        before += sums[t];
    for (uint k = first; k < end; k++)
    {
        uint here = _BeamDigits[k];
        _BeamDigits[k] = before;
        before += here;
    }
}

[numthreads(64, 1, 1)]
void Scatter(uint3 group : SV_GroupID, uint3 thread : SV_GroupThreadID)
{
    countRun(group.x, thread.x);
    if (thread.x < DIGITS)
    {
        uint before = _BeamDigits[thread.x * uint(_BeamSort.y) + group.x];
        for (uint t = 0u; t < THREADS; t++)
        {
            uint here = counts[thread.x * THREADS + t];
            counts[thread.x * THREADS + t] = before;
            before += here;
        }
    }
    GroupMemoryBarrierWithGroupSync();
    uint first = (group.x * THREADS + thread.x) * RUN;
    for (uint i = first; i < min(first + RUN, uint(_BeamSort.x)); i++)
    {
        uint2 item = _BeamUnsorted[i];
        uint place = digitOf(item.x) * THREADS + thread.x;
        _BeamSorted[counts[place]] = item;
        counts[place]++;
    }
}

/// Keep the numbers of Gaussians.
[numthreads(64, 1, 1)]
void Order(uint3 thread : SV_DispatchThreadID)
{
    if (thread.x < uint(_BeamSort.x))
        _BeamOrdered[thread.x] = _BeamUnsorted[thread.x].y;
}
