// Irradiance of the environment at every Gaussian of a take, shadows of its regions taken into account.

#include "Gaussians.hlsl"
#include "Light.hlsl"

StructuredBuffer<float4> _BeamRegions; // three rows a region: moments of red, green and blue, turned as the environment is
RWStructuredBuffer<float4> _BeamArrivals; // irradiance, and its share of the unshadowed luminance
float4 _BeamCounts; // Gaussians, regions

int regionCount()
{
    return int(_BeamCounts.y);
}

Region regionAt(int k)
{
    Region region;
    region.red = _BeamRegions[3 * k];
    region.green = _BeamRegions[3 * k + 1];
    region.blue = _BeamRegions[3 * k + 2];
    region.map = k;
    return region;
}

[numthreads(64, 1, 1)]
void Arrive(uint3 thread : SV_DispatchThreadID)
{
    if (thread.x >= uint(_BeamCounts.x))
        return;
    Gaussian g = gaussianAt(thread.x);
    _BeamArrivals[thread.x] = arrivingLight(g.position, g.normal, g.ambientOcclusion, randomTurn(thread.x), _BeamTurn.xy);
}
