// The cameras that are drawn: one, or one an eye. Rows of pixels are counted as the target's are in memory.

#ifndef BEAM_VIEWS
#define BEAM_VIEWS

#include "Gaussians.hlsl"

float4x4 _BeamCamera[2]; // rows: position and 0, right, down, forward
float4 _BeamLens[2]; // focal lengths, centre [pixel]
float4 _BeamDepths[2]; // (a, b, c, d): depth z is stored as (b - a z) / (d - c z)
float4 _BeamTarget; // width, height; 1, or -1 where rows of a target are counted against clip space; near [m]
float4 _BeamFilter; // variance [pixel^2] of the low-pass; 1 if opacity is kept

Pinhole eyeView(uint eye)
{
    float4x4 camera = _BeamCamera[eye];
    float4 lens = _BeamLens[eye];
    Pinhole view;
    view.position = camera[0].xyz;
    view.right = camera[1].xyz;
    view.down = camera[2].xyz;
    view.forward = camera[3].xyz;
    view.focal = lens.xy;
    view.center = lens.zw;
    view.size = _BeamTarget.xy;
    return view;
}

/// Clip position of a place [pixel].
float4 clipOf(float2 pixel)
{
    float2 unit = 2.0 * pixel / _BeamTarget.xy - 1.0;
    return float4(unit.x, -_BeamTarget.z * unit.y, 0.5, 1.0);
}

/// Depth [m] of what a depth buffer holds.
float storedDepth(uint eye, float stored)
{
    float4 d = _BeamDepths[eye];
    return (d.y - stored * d.w) / (d.x - stored * d.z);
}

/// What a depth buffer holds for a depth [m].
float depthToStore(uint eye, float depth)
{
    float4 d = _BeamDepths[eye];
    return (d.y - d.x * depth) / (d.w - d.z * depth);
}

#endif
