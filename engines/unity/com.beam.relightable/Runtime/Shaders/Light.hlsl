// What the functions of Relight.hlsl fetch: an environment, and shadow maps of lamps or of an environment's regions.

Texture2DArray<float4> _BeamShadowSums; // of Gaussians: depth times alpha, alpha in z and w
Texture2DArray<float4> _BeamShadowFirst; // depth of the nearest splat that hides a quarter [m], 0 for none
Texture2DArray<float4> _BeamShadowMeshes; // depth of triangles [m]; where there are none, a great one
StructuredBuffer<float4> _BeamEnvironment; // texels of all levels, and irradiance
StructuredBuffer<float4> _BeamAlbedo; // (A, B), 64 x 64
StructuredBuffer<float4> _BeamShadowViews; // six rows a map
float4 _BeamLevels[14]; // rows, and first texel; the last is the irradiance
float4 _BeamTurn; // cosine and sine of the environment's angle about z; number of lamps; exposure, a factor

#define RELIGHT_FETCHING
#include "Relight.hlsl"

int environmentRows(int level)
{
    return int(_BeamLevels[level < 0 ? 13 : level].x);
}

float3 environmentTexel(int level, int2 cell)
{
    float4 place = _BeamLevels[level < 0 ? 13 : level];
    return _BeamEnvironment[int(place.y) + cell.y * 2 * int(place.x) + cell.x].xyz;
}

float2 albedoTexel(int2 cell)
{
    return _BeamAlbedo[cell.y * 64 + cell.x].xy;
}

ShadowView shadowView(int map)
{
    ShadowView view;
    float4 place = _BeamShadowViews[6 * map];
    float4 right = _BeamShadowViews[6 * map + 1];
    float4 down = _BeamShadowViews[6 * map + 2];
    float4 forward = _BeamShadowViews[6 * map + 3];
    float4 lens = _BeamShadowViews[6 * map + 4];
    view.position = place.xyz;
    view.radius = place.w;
    view.right = right.xyz;
    view.front = right.w;
    view.down = down.xyz;
    view.thickness = down.w;
    view.forward = forward.xyz;
    view.largestKernel = forward.w;
    view.focal = lens.xy;
    view.center = lens.zw;
    view.size = _BeamShadowViews[6 * map + 5].xy;
    return view;
}

float4 shadowTexel(int map, int2 cell)
{
    float4 sums = _BeamShadowSums.Load(int4(cell, map, 0));
    float mesh = _BeamShadowMeshes.Load(int4(cell, map, 0)).x;
    float mean = sums.w > 0.0 ? sums.z / sums.w : 0.0;
    float first = _BeamShadowFirst.Load(int4(cell, map, 0)).x;
    return float4(min(sums.w, 1.0), first > 0.0 ? first : mean, mean, mesh);
}
