// The G-buffer of a take: sorted splats, blended back to front as "One OneMinusSrcAlpha". BEAM_SHADOW_MAP draws depth alone.

#include "Views.hlsl"
#include "Stereo.hlsl"

StructuredBuffer<uint> _BeamOrder; // farthest first
#if defined(BEAM_REGIONS)
StructuredBuffer<float4> _BeamArriving; // what Arriving.hlsl found
#endif

#if defined(BEAM_DEPTH_ARRAY)
Texture2DArray<float4> _CameraDepthTexture;
#elif !defined(BEAM_SHADOW_MAP)
Texture2D<float4> _CameraDepthTexture;
#endif

/// Alpha from which on a splat counts as what is first. Splats of a surface overlap, so that the one by which a half is hidden,
/// whose depth is the median, comes soon after the first that hides a quarter. Blending knows no sum of those before.
static const float HIDING = 0.25;

struct SplatCorner
{
    float4 clip : SV_Position;
    float2 offset : TEXCOORD0;
    nointerpolation float4 shape : TEXCOORD1; // and reach
    nointerpolation float4 plane : TEXCOORD2; // slope, depth, logOpacity
    nointerpolation float4 look : TEXCOORD3; // base colour, roughness
    nointerpolation float4 normal : TEXCOORD4; // and ambient occlusion, or the share of the environment that arrives
    nointerpolation uint eye : TEXCOORD5;
#if defined(BEAM_REGIONS)
    nointerpolation float3 arriving : TEXCOORD6;
#endif
    BEAM_EYE_OUTPUT
};

struct Sums
{
    float4 look : SV_Target0; // base colour, alpha
    float4 normal : SV_Target1; // normal, alpha
    float4 rest : SV_Target2; // roughness, ambient occlusion, depth, alpha
    float4 first : SV_Target3; // depth of the nearest splat of HIDING: blended as if it hid all
#if defined(BEAM_REGIONS)
    float4 arriving : SV_Target4; // irradiance of the environment, alpha
#endif
};

SplatCorner SplatVertex(uint vertex : SV_VertexID BEAM_EYE_INPUT)
{
    uint eye = BEAM_EYE;
    uint corner = vertex % 6u;
    float2 side = float2(corner == 1u || corner == 2u || corner == 4u ? 1.0 : -1.0, corner == 2u || corner == 4u || corner == 5u ? 1.0 : -1.0);
    uint index = _BeamOrder[vertex / 6u];
    Gaussian g = gaussianAt(index);
    Splat splat = project(g, eyeView(eye), _BeamTarget.w, _BeamFilter.x, _BeamFilter.y > 0.5);
    SplatCorner output = (SplatCorner)0;
    output.offset = cornerOf(splat, side);
    output.clip = splat.logOpacity > -LOG_CUT ? clipOf(splat.center + output.offset) : float4(2.0, 2.0, 2.0, 1.0);
    output.shape = float4(splat.shape, splat.reach);
    output.plane = float4(splat.slope, splat.depth, splat.logOpacity);
    output.look = float4(g.baseColor, g.roughness);
    output.normal = float4(g.normal, g.ambientOcclusion);
#if defined(BEAM_REGIONS)
    float4 arriving = _BeamArriving[index];
    output.arriving = arriving.xyz;
    output.normal.w = arriving.w;
#endif
    output.eye = eye;
    BEAM_SET_EYE(output, eye)
    return output;
}

Splat splatOf(SplatCorner input)
{
    Splat splat = (Splat)0;
    splat.shape = input.shape.xyz;
    splat.reach = input.shape.w;
    splat.slope = input.plane.xy;
    splat.depth = input.plane.z;
    splat.logOpacity = input.plane.w;
    return splat;
}

#if defined(BEAM_SHADOW_MAP)
struct ShadowSums
{
    float4 mean : SV_Target0; // depth in z, alpha
    float4 first : SV_Target1; // depth of the nearest splat of HIDING: blended as if it hid all
};

ShadowSums SplatFragment(SplatCorner input)
{
    Splat splat = splatOf(input);
    float alpha = alphaAt(splat, input.offset);
    if (!(alpha > 0.0))
        discard;
    float depth = depthAt(splat, input.offset, _BeamTarget.w);
    float hides = alpha >= HIDING ? 1.0 : 0.0;
    ShadowSums sums;
    sums.mean = float4(0.0, 0.0, depth * alpha, alpha);
    sums.first = float4(depth * hides, 0.0, 0.0, hides);
    return sums;
}
#else
/// Depth [m] of the scene's opaque surfaces.
float sceneDepth(uint eye, int2 pixel)
{
#if defined(BEAM_DEPTH_ARRAY)
    return storedDepth(eye, _CameraDepthTexture.Load(int4(pixel, eye, 0)).x);
#else
    return storedDepth(eye, _CameraDepthTexture.Load(int3(pixel, 0)).x);
#endif
}

Sums SplatFragment(SplatCorner input)
{
    Splat splat = splatOf(input);
    float alpha = alphaAt(splat, input.offset);
    float depth = depthAt(splat, input.offset, _BeamTarget.w);
    if (!(alpha > 0.0) || depth > sceneDepth(input.eye, int2(input.clip.xy)))
        discard;
    Sums sums;
    sums.look = float4(input.look.xyz * alpha, alpha);
    sums.normal = float4(input.normal.xyz * alpha, alpha);
    float hides = alpha >= HIDING ? 1.0 : 0.0;
    sums.first = float4(depth * hides, 0.0, 0.0, hides);
    sums.rest = float4(input.look.w * alpha, input.normal.w * alpha, depth * alpha, alpha);
#if defined(BEAM_REGIONS)
    sums.arriving = float4(input.arriving * alpha, alpha);
#endif
    return sums;
}
#endif
