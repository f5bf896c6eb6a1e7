// Passes of a take; RelightPass.cs and ShadowMaps.cs draw them.
Shader "Hidden/Beam/Relight"
{
    SubShader
    {
        Cull Off
        ZWrite Off
        ZTest Always

        Pass
        {
            Name "Splats"
            Blend One OneMinusSrcAlpha
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex SplatVertex
            #pragma fragment SplatFragment
            #pragma multi_compile_local _ BEAM_DEPTH_ARRAY
            #pragma multi_compile_local _ BEAM_REGIONS
            #include "../../Shaders/Splats.hlsl"
            ENDHLSL
        }

        Pass
        {
            Name "ShadowMap"
            Blend One OneMinusSrcAlpha
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex SplatVertex
            #pragma fragment SplatFragment
            #define BEAM_SHADOW_MAP
            #include "../../Shaders/Splats.hlsl"
            ENDHLSL
        }

        Pass
        {
            Name "Meshes"
            Blend One One
            BlendOp Min
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex MeshVertex
            #pragma fragment MeshFragment
            #include "../../Shaders/Meshes.hlsl"
            ENDHLSL
        }

        Pass
        {
            Name "Light"
            Blend One OneMinusSrcAlpha
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex DeferredVertex
            #pragma fragment DeferredFragment
            #pragma multi_compile_local _ BEAM_EXPOSED
            #pragma multi_compile_local _ BEAM_REGIONS
            #include "../../Shaders/Deferred.hlsl"
            ENDHLSL
        }

        Pass
        {
            Name "Depth"
            ZWrite On
            ZTest LEqual
            ColorMask 0
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex DeferredVertex
            #pragma fragment DepthFragment
            #include "../../Shaders/Deferred.hlsl"
            ENDHLSL
        }
    }
}
