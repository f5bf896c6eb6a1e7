// The light of a G-buffer: environment and lamps with shadow maps, by the functions of Relight.hlsl.

#include "Views.hlsl"
#include "Stereo.hlsl"

Texture2DArray<float4> _BeamLook;
Texture2DArray<float4> _BeamNormal;
Texture2DArray<float4> _BeamRest;
Texture2DArray<float4> _BeamFirst;
#if defined(BEAM_REGIONS)
Texture2DArray<float4> _BeamArrived; // of the environment, shadows of its regions taken into account
#endif
StructuredBuffer<float4> _BeamLamps; // four rows a lamp

#if defined(BEAM_EXPOSED)
Texture2D<float4> _ExposureTexture; // HDRP's: colours are multiplied by what it holds
#endif

#include "Light.hlsl"

int regionCount()
{
    return 0; // Arriving.hlsl reads their maps
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
#if defined(BEAM_REGIONS)
    float4 arrived = _BeamArrived.Load(int4(pixel, input.eye, 0));
    float3 radiance = shadowedRadiance(surface, arrived.xyz / max(arrived.w, 1.0e-6), _BeamTurn.xy);
#else
    float3 radiance = environmentRadiance(surface, _BeamTurn.xy);
#endif
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
