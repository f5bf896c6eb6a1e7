// Gaussians of a take as shaders see them, and their projection to splats.
//
// Formulas and sources stand in kernels/raster/{project,splat_rows}.py, whose images tests compare with these. "World" is
// x right, y forward, z up, right-handed, in metres: Unity's world with y and z exchanged.

#ifndef BEAM_GAUSSIANS
#define BEAM_GAUSSIANS

static const float LOG_CUT = 5.541263545158426; // ln 255: a fainter alpha does not reach an 8-bit image
static const float ALPHA_MAX = 0.99;
static const float DEPTH_REACH = 3.0;
static const float SMALLEST_SCALE = 1.0e-12;
static const uint ROWS = 5;

struct Gaussian
{
    float3 position;
    float opacity;
    float4 orientation; // xyzw
    float3 scale;
    float roughness;
    float3 baseColor;
    float ambientOcclusion;
    float3 normal;
};

/// A pinhole camera: unit axes, focal lengths and centre [pixel], size [pixel]; one eye, or one shadow map.
struct Pinhole
{
    float3 position;
    float3 right;
    float3 down;
    float3 forward;
    float2 focal;
    float2 center;
    float2 size;
};

/// A splat. With d the way from its centre to a pixel, alpha is exp(logOpacity - (e0^2 + e1^2) / 2), e0 = shape.x d.x,
/// e1 = shape.z (d.y - shape.y d.x), and the depth of its plane is depth / (1 + dot(slope, d)), at most reach away.
struct Splat
{
    float2 center;
    float logOpacity; // below -LOG_CUT: not drawn
    float depth;
    float3 shape;
    float reach;
    float2 slope;
};

StructuredBuffer<float4> _BeamGaussians; // ROWS of each
float4x4 _BeamObject; // from the take's axes to the world: a turn, a mirror, a uniform scale

Gaussian gaussianAt(uint i)
{
    float4 place = _BeamGaussians[ROWS * i];
    float4 size = _BeamGaussians[ROWS * i + 2];
    float4 look = _BeamGaussians[ROWS * i + 3];
    Gaussian g;
    g.position = mul(_BeamObject, float4(place.xyz, 1.0)).xyz;
    g.opacity = place.w;
    g.orientation = _BeamGaussians[ROWS * i + 1];
    g.scale = size.xyz * length(mul(_BeamObject, float4(1.0, 0.0, 0.0, 0.0)).xyz);
    g.roughness = size.w;
    g.baseColor = look.xyz;
    g.ambientOcclusion = look.w;
    float3 normal = mul(_BeamObject, float4(_BeamGaussians[ROWS * i + 4].xyz, 0.0)).xyz;
    g.normal = normal / max(length(normal), 1.0e-12);
    return g;
}

/// Unit axes of a Gaussian in the world.
void axesOf(Gaussian g, out float3 first, out float3 second, out float3 third)
{
    float4 q = g.orientation;
    float3x3 object = (float3x3)_BeamObject;
    first = normalize(mul(object, float3(1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.z * q.w), 2.0 * (q.x * q.z - q.y * q.w))));
    second = normalize(mul(object, float3(2.0 * (q.x * q.y - q.z * q.w), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + q.x * q.w))));
    third = normalize(mul(object, float3(2.0 * (q.x * q.z + q.y * q.w), 2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.x * q.x + q.y * q.y))));
}

/// Right, down and forward parts of a world vector.
float3 inCamera(Pinhole view, float3 v)
{
    return float3(dot(view.right, v), dot(view.down, v), dot(view.forward, v));
}

/// Elliptical weighted averaging with a low-pass of that variance [pixel^2].
Splat project(Gaussian g, Pinhole view, float near, float lowPass, bool antialiased)
{
    Splat splat = (Splat)0;
    splat.logOpacity = -100.0;
    float3 p = inCamera(view, g.position - view.position);
    if (!(p.z > near))
        return splat;
    float3 first, second, third;
    axesOf(g, first, second, third);
    first = inCamera(view, first);
    second = inCamera(view, second);
    third = inCamera(view, third);
    float3 away = float3(p.xy / p.z, 1.0);
    float2 margin = 0.15 * view.size / view.focal;
    float2 side = abs(margin);
    float2 low = -view.center / view.focal;
    float2 high = (view.size - view.center) / view.focal;
    float2 at = clamp(away.xy, min(low, high) - side, max(low, high) + side);
    float3 rowX = float3(first.x, second.x, third.x);
    float3 rowY = float3(first.y, second.y, third.y);
    float3 rowZ = float3(first.z, second.z, third.z);
    float3 t0 = view.focal.x / p.z * (rowX - at.x * rowZ) * g.scale;
    float3 t1 = view.focal.y / p.z * (rowY - at.y * rowZ) * g.scale;
    float3 crossed = cross(t0, t1);
    float sharp = dot(crossed, crossed);
    float xx = dot(t0, t0) + lowPass;
    float xy = dot(t0, t1);
    float det = sharp + lowPass * (dot(t0, t0) + dot(t1, t1)) + lowPass * lowPass;
    float kept = antialiased ? sharp / det : 1.0;
    if (!(g.opacity * g.opacity * kept > 1.5378700499807768e-05) || !(det > 0.0 && det < 1.0e30))
        return splat;
    float3 thick = max(g.scale, SMALLEST_SCALE);
    float3 inverse = min(thick.x, min(thick.y, thick.z)) / thick;
    float3 a = inverse * (away.x * rowX + away.y * rowY + rowZ);
    splat.center = view.focal * away.xy + view.center;
    splat.logOpacity = log(g.opacity) + 0.5 * log(kept);
    splat.depth = p.z;
    splat.shape = float3(rsqrt(xx), xy / xx, sqrt(xx / det));
    splat.reach = DEPTH_REACH * max(g.scale.x, max(g.scale.y, g.scale.z));
    splat.slope = float2(dot(a, inverse * rowX) / view.focal.x, dot(a, inverse * rowY) / view.focal.y) / dot(a, a);
    return splat;
}

/// Corner of the rectangle, along the ellipse's axes, that holds all of a splat that is seen: from its centre [pixel].
float2 cornerOf(Splat splat, float2 side)
{
    float standard = sqrt(2.0 * max(LOG_CUT + splat.logOpacity, 0.0));
    float xx = 1.0 / (splat.shape.x * splat.shape.x);
    float xy = splat.shape.y * xx;
    float yy = splat.shape.y * xy + 1.0 / (splat.shape.z * splat.shape.z);
    float middle = 0.5 * (xx + yy);
    float apart = 0.5 * (xx - yy);
    float spread = sqrt(apart * apart + xy * xy);
    float turn = 0.5 * atan2(xy, apart);
    float2 axis = abs(xy) + abs(apart) > 0.0 ? float2(cos(turn), sin(turn)) : float2(1.0, 0.0);
    // the smaller eigenvalue by the determinant: a needle's would cancel
    float large = middle + spread;
    float small = xx / (splat.shape.z * splat.shape.z) / large;
    float2 size = standard * sqrt(float2(large, small)) * 1.00001 + 0.01;
    return side.x * size.x * axis + side.y * size.y * float2(-axis.y, axis.x);
}

/// Alpha of a splat at a way from its centre [pixel]; 0 where it is cut.
float alphaAt(Splat splat, float2 offset)
{
    float2 e = float2(offset.x * splat.shape.x, (offset.y - splat.shape.y * offset.x) * splat.shape.z);
    float logAlpha = splat.logOpacity - 0.5 * dot(e, e);
    return logAlpha >= -LOG_CUT ? min(exp(logAlpha), ALPHA_MAX) : 0.0;
}

/// Depth of a splat's plane at a way from its centre [pixel].
float depthAt(Splat splat, float2 offset, float near)
{
    float facing = 1.0 + dot(splat.slope, offset);
    float far = splat.depth + splat.reach;
    float depth = facing > 0.0 ? min(splat.depth / facing, far) : far;
    return max(depth, max(splat.depth - splat.reach, near));
}

#endif
