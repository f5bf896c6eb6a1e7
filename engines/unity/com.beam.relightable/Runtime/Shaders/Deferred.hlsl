// The light of a G-buffer: environment and lamps with shadow maps, by the functions of Relight.hlsl.

#include "Views.hlsl"
#include "Stereo.hlsl"

Texture2DArray<float4> _BeamLook;
Texture2DArray<float4> _BeamNormal;
Texture2DArray<float4> _BeamRest;
Texture2DArray<float4> _BeamFirst;
Texture2DArray<float4> _BeamShadowSums; // of Gaussians: depth times alpha, alpha in z and w
Texture2DArray<float4> _BeamShadowFirst; // depth of the nearest splat that hides a quarter [m], 0 for none
Texture2DArray<float4> _BeamShadowMeshes; // depth of triangles [m]; where there are none, a great one
StructuredBuffer<float4> _BeamEnvironment; // texels of all levels, and irradiance
StructuredBuffer<float4> _BeamAlbedo; // (A, B), 64 x 64
StructuredBuffer<float4> _BeamLamps; // four rows a lamp
StructuredBuffer<float4> _BeamShadowViews; // six rows a map
float4 _BeamLevels[14]; // rows, and first texel; the last is the irradiance
float4 _BeamTurn; // cosine and sine of the environment's angle about z; number of lamps; exposure, a factor

#if defined(BEAM_EXPOSED)
Texture2D<float4> _ExposureTexture; // HDRP's: colours are multiplied by what it holds
#endif

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

int regionCount()
{
    return 0; // ambient occlusion stands for the environment's shadows
}

Region regionAt(int k)
{
    Region region = (Region)0;
    region.map = k;
    return region;
}

Lamp lampAt(int k)
{
    float4 place = _BeamLamps[4 * k];
    float4 way = _BeamLamps[4 * k + 1];
    float4 power = _BeamLamps[4 * k + 2];
    float4 rest = _BeamLamps[4 * k + 3];
    Lamp lamp;
    lamp.position = place.xyz;
    lamp.kind = int(place.w);
    lamp.direction = way.xyz;
    lamp.size = way.w;
    lamp.power = power.xyz;
    lamp.firstMap = int(power.w);
    lamp.cone = rest.xy;
    lamp.mapCount = int(rest.z);
    return lamp;
}

struct WholeScreen
{
    float4 clip : SV_Position;
    nointerpolation uint eye : TEXCOORD0;
    BEAM_EYE_OUTPUT
};

WholeScreen DeferredVertex(uint vertex : SV_VertexID BEAM_EYE_INPUT)
{
    uint eye = BEAM_EYE;
    WholeScreen output = (WholeScreen)0;
    output.clip = float4(vertex == 1u ? 3.0 : -1.0, vertex == 2u ? 3.0 : -1.0, 0.5, 1.0);
    output.eye = eye;
    BEAM_SET_EYE(output, eye)
    return output;
}

/// Radiance multiplied by alpha, and alpha.
float4 DeferredFragment(WholeScreen input) : SV_Target0
{
    int2 pixel = int2(input.clip.xy);
    float4 look = _BeamLook.Load(int4(pixel, input.eye, 0));
    float4 normal = _BeamNormal.Load(int4(pixel, input.eye, 0));
    float4 rest = _BeamRest.Load(int4(pixel, input.eye, 0));
    float alpha = min(rest.w, 1.0);
    if (!(alpha > 0.0))
        discard;
    Pinhole view = eyeView(input.eye);
    float3 ray = pixelRay(float2(pixel) + 0.5, view.focal, view.center, view.right, view.down, view.forward);
    // where the front leaks the mean lies inside the body, where no light arrives
    float first = _BeamFirst.Load(int4(pixel, input.eye, 0)).x;
    float depth = first > 0.0 ? min(rest.z / rest.w, first) : rest.z / rest.w;
    Surface surface = surfaceOfSums(look.xyz * (rest.w / max(look.w, 1.0e-6)), rest.x, rest.y, normal.xyz, rest.w, view.position, ray, depth);
    float3 radiance = environmentRadiance(surface, _BeamTurn.xy);
    float2 turn = randomTurn(uint(pixel.y) * uint(_BeamTarget.x) + uint(pixel.x));
    for (int k = 0; k < int(_BeamTurn.z); k++)
        radiance += lampRadiance(surface, lampAt(k), turn);
    float gain = _BeamTurn.w;
#if defined(BEAM_EXPOSED)
    int2 only = int2(0, 0);
    gain *= _ExposureTexture.Load(int3(only, 0)).x;
#endif
    return float4(radiance * (alpha * gain), alpha);
}

/// Depth of the take for what is drawn later, where it hides more than half.
float DepthFragment(WholeScreen input) : SV_Depth
{
    float4 rest = _BeamRest.Load(int4(int2(input.clip.xy), input.eye, 0));
    if (!(rest.w > 0.5))
        discard;
    return depthToStore(input.eye, rest.z / rest.w);
}
