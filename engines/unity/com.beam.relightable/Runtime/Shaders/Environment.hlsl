// Light of a scene's reflection cube, as levels of lat-long maps: what Relight.hlsl reads.

TextureCube<float4> _BeamCube; // its mip levels blurred by roughness, as reflection probes are
SamplerState sampler_BeamCube;
RWStructuredBuffer<float4> _BeamTexels;
float4 _BeamLevel; // rows, first texel, mip level, factor
float4 _BeamSource; // rows and first texel of the level that irradiance is summed from

static const float PI = 3.14159265358979323846;

/// Direction of a texel's middle: z up, the middle of the image is +x.
float3 directionAt(int2 cell, int rows)
{
    float azimuth = (0.5 - (float(cell.x) + 0.5) / float(2 * rows)) * 2.0 * PI;
    float polar = (float(cell.y) + 0.5) / float(rows) * PI;
    return float3(sin(polar) * cos(azimuth), sin(polar) * sin(azimuth), cos(polar));
}

[numthreads(64, 1, 1)]
void FromCube(uint3 thread : SV_DispatchThreadID)
{
    int rows = int(_BeamLevel.x);
    int2 cell = int2(int(thread.x) % (2 * rows), int(thread.x) / (2 * rows));
    if (cell.y >= rows)
        return;
    float3 d = directionAt(cell, rows).xzy; // Unity's world has y up
    _BeamTexels[uint(_BeamLevel.y) + thread.x] = float4(_BeamCube.SampleLevel(sampler_BeamCube, d, _BeamLevel.z).xyz * _BeamLevel.w, 1.0);
}

/// Irradiance by a sum over all texels of a level.
[numthreads(64, 1, 1)]
void Irradiance(uint3 thread : SV_DispatchThreadID)
{
    int rows = int(_BeamLevel.x);
    int2 cell = int2(int(thread.x) % (2 * rows), int(thread.x) / (2 * rows));
    if (cell.y >= rows)
        return;
    float3 normal = directionAt(cell, rows);
    int sourceRows = int(_BeamSource.x);
    float3 total = float3(0.0, 0.0, 0.0);
    for (int y = 0; y < sourceRows; y++)
    {
        float height = cos(float(y) / float(sourceRows) * PI) - cos(float(y + 1) / float(sourceRows) * PI);
        float angle = height * PI / float(sourceRows);
        for (int x = 0; x < 2 * sourceRows; x++)
        {
            float cosine = max(dot(normal, directionAt(int2(x, y), sourceRows)), 0.0);
            total += _BeamTexels[uint(_BeamSource.y) + uint(y * 2 * sourceRows + x)].xyz * (cosine * angle);
        }
    }
    _BeamTexels[uint(_BeamLevel.y) + thread.x] = float4(total, 1.0);
}
