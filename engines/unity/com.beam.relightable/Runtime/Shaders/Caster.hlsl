// Splats in Unity's own shadow maps, by whose matrices they are drawn: takes cast shadows on the scene.

#if defined(BEAM_HDRP)
#include "Packages/com.unity.render-pipelines.core/ShaderLibrary/Common.hlsl"
#include "Packages/com.unity.render-pipelines.high-definition/Runtime/ShaderLibrary/ShaderVariables.hlsl"
#else
#include "Packages/com.unity.render-pipelines.universal/ShaderLibrary/Core.hlsl"
#endif
#include "Gaussians.hlsl"

struct CasterCorner
{
    float4 clip : SV_Position;
    float2 e : TEXCOORD0; // way from the centre [standard deviations]
    nointerpolation float opacity : TEXCOORD1;
};

/// Clip position of a point of the renderer's world.
float4 casterClip(float3 position)
{
#if defined(BEAM_HDRP)
    return mul(UNITY_MATRIX_VP, float4(GetCameraRelativePositionWS(position.xzy), 1.0));
#else
    return mul(UNITY_MATRIX_VP, float4(position.xzy, 1.0));
#endif
}

CasterCorner CasterVertex(uint vertex : SV_VertexID)
{
    uint corner = vertex % 6u;
    float2 side = float2(corner == 1u || corner == 2u || corner == 4u ? 1.0 : -1.0, corner == 2u || corner == 4u || corner == 5u ? 1.0 : -1.0);
    Gaussian g = gaussianAt(vertex / 6u);
    float3 first, second, third;
    axesOf(g, first, second, third);
    float4 center = casterClip(g.position);
    float2 middle = center.xy / center.w;
    // the Jacobian of the projection: how a step along each axis moves the centre, in halves of the map
    float4 a = casterClip(g.position + g.scale.x * first) - center;
    float4 b = casterClip(g.position + g.scale.y * second) - center;
    float4 c = casterClip(g.position + g.scale.z * third) - center;
    float2 x = (a.xy - middle * a.w) / center.w;
    float2 y = (b.xy - middle * b.w) / center.w;
    float2 z = (c.xy - middle * c.w) / center.w;
    float xx = x.x * x.x + y.x * y.x + z.x * z.x + 1.0e-12;
    float xy = x.x * x.y + y.x * y.y + z.x * z.y;
    float yy = x.y * x.y + y.y * y.y + z.y * z.y + 1.0e-12;
    // Cholesky: two edges of the unit square's image
    float lean = rsqrt(xx);
    float rest = sqrt(max(yy - xy * xy * lean * lean, 1.0e-12));
    float reach = sqrt(2.0 * max(log(max(g.opacity, 1.0e-6)) - log(0.5), 0.0));
    CasterCorner output;
    output.e = side * reach;
    output.opacity = g.opacity;
    float2 offset = output.e.x * float2(xx * lean, xy * lean) + output.e.y * float2(0.0, rest);
    bool isSeen = reach > 0.0 && center.w > 0.0;
    output.clip = isSeen ? float4(center.xy + offset * center.w, center.zw) : float4(2.0, 2.0, 2.0, 1.0);
    return output;
}

/// What hides more than half casts a shadow.
float4 CasterFragment(CasterCorner input) : SV_Target0
{
    if (!(input.opacity * exp(-0.5 * dot(input.e, input.e)) >= 0.5))
        discard;
    return float4(1.0, 1.0, 1.0, 1.0); // masked in the shadow pass
}
