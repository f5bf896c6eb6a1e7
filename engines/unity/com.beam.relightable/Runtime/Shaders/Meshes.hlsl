// Depth of meshes in a shadow map, blended by the minimum.

#include "Views.hlsl"

float4x4 unity_ObjectToWorld;

struct MeshPoint
{
    float4 clip : SV_Position;
    float depth : TEXCOORD0;
};

MeshPoint MeshVertex(float3 corner : POSITION)
{
    Pinhole view = eyeView(0u);
    float3 world = mul(unity_ObjectToWorld, float4(corner, 1.0)).xzy; // Unity's world has y up
    float3 p = inCamera(view, world - view.position);
    float2 place = 2.0 * (view.focal * p.xy + view.center * p.z) / view.size - p.z;
    MeshPoint output;
    output.clip = float4(place.x, -_BeamTarget.z * place.y, 0.5 * p.z, p.z);
    output.depth = p.z;
    return output;
}

float4 MeshFragment(MeshPoint input) : SV_Target0
{
    if (!(input.depth > _BeamTarget.w))
        discard;
    return float4(input.depth, 0.0, 0.0, 1.0);
}
