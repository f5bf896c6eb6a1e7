// Frames of a take, evaluated from its planes: docs/delivery.md says what components stand for.

ByteAddressBuffer _BeamStill; // planes of the static block
ByteAddressBuffer _BeamSegment; // of the segment that holds the time
ByteAddressBuffer _BeamNext; // of the one after it
StructuredBuffer<uint4> _BeamTerms; // bits of the weight, offset of the plane [byte], its kind, its buffer
StructuredBuffer<float4> _BeamComponents; // of each of 21 components: sum of offsets, first term, their number
RWStructuredBuffer<float4> _BeamEvaluated; // five rows a Gaussian
float4 _BeamCounts; // Gaussians

uint word(uint block, uint at)
{
    if (block == 0u)
        return _BeamStill.Load(at);
    return block == 1u ? _BeamSegment.Load(at) : _BeamNext.Load(at);
}

/// Number i of a plane: a float, or an integer of 1, 2 or 4 bytes.
float numberAt(uint block, uint plane, uint kind, uint i)
{
    uint bytes = kind == 0u ? 4u : kind;
    uint at = plane + bytes * i;
    uint found = word(block, at & ~3u);
    if (kind == 0u)
        return asfloat(found);
    uint shift = 32u - 8u * bytes;
    return float(asint(found << (shift - 8u * (at & 3u))) >> int(shift));
}

float component(uint c, uint i)
{
    float4 said = _BeamComponents[c];
    float value = said.x;
    for (uint k = uint(said.y); k < uint(said.y + said.z); k++)
    {
        uint4 term = _BeamTerms[k];
        value += asfloat(term.x) * numberAt(term.w, term.y, term.z, i);
    }
    return value;
}

float3 components(uint first, uint i)
{
    return float3(component(first, i), component(first + 1u, i), component(first + 2u, i));
}

/// Unit quaternion xyzw of modified Rodrigues parameters.
float4 quaternion(float3 rodrigues)
{
    float square = dot(rodrigues, rodrigues);
    return float4(2.0 * rodrigues, 1.0 - square) / (1.0 + square);
}

[numthreads(64, 1, 1)]
void Evaluate(uint3 thread : SV_DispatchThreadID)
{
    uint i = thread.x;
    if (i >= uint(_BeamCounts.x))
        return;
    float4 turn = quaternion(components(6u, i));
    float4 q = quaternion(components(3u, i));
    float3 scale = components(9u, i);
    float3 normal = components(18u, i);
    normal /= max(length(normal), 1.0e-12);
    float3 twice = 2.0 * cross(turn.xyz, normal);
    scale = float3(scale.x < -29.0 ? 0.0 : exp(min(scale.x, 20.0)), scale.y < -29.0 ? 0.0 : exp(min(scale.y, 20.0)), scale.z < -29.0 ? 0.0 : exp(min(scale.z, 20.0)));
    _BeamEvaluated[5u * i] = float4(components(0u, i), saturate(component(12u, i)));
    _BeamEvaluated[5u * i + 1u] = float4(turn.w * q.xyz + q.w * turn.xyz + cross(turn.xyz, q.xyz), turn.w * q.w - dot(turn.xyz, q.xyz));
    _BeamEvaluated[5u * i + 2u] = float4(scale, saturate(component(16u, i)));
    _BeamEvaluated[5u * i + 3u] = float4(saturate(components(13u, i)), saturate(component(17u, i)));
    _BeamEvaluated[5u * i + 4u] = float4(normal + turn.w * twice + cross(turn.xyz, twice), 0.0);
}
