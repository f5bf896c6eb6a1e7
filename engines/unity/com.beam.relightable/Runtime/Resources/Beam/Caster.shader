// Splats in Unity's own shadow maps.
Shader "Hidden/Beam/Caster"
{
    SubShader
    {
        PackageRequirements { "com.unity.render-pipelines.high-definition": "17.0.0" }
        Tags { "RenderPipeline" = "HDRenderPipeline" }

        Pass
        {
            Name "ShadowCaster"
            Tags { "LightMode" = "ShadowCaster" }
            Cull Off
            ColorMask 0
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex CasterVertex
            #pragma fragment CasterFragment
            #define BEAM_HDRP
            #include "../../Shaders/Caster.hlsl"
            ENDHLSL
        }
    }

    SubShader
    {
        PackageRequirements { "com.unity.render-pipelines.universal": "17.0.0" }
        Tags { "RenderPipeline" = "UniversalPipeline" }

        Pass
        {
            Name "ShadowCaster"
            Tags { "LightMode" = "ShadowCaster" }
            Cull Off
            ColorMask 0
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex CasterVertex
            #pragma fragment CasterFragment
            #include "../../Shaders/Caster.hlsl"
            ENDHLSL
        }
    }
}
