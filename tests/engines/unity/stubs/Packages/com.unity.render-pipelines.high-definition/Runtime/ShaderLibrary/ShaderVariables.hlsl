// What Caster.hlsl takes of HDRP.
float4x4 unity_MatrixVP;
float4 _WorldSpaceCameraPos;
#define UNITY_MATRIX_VP unity_MatrixVP
float3 GetCameraRelativePositionWS(float3 position) { return position - _WorldSpaceCameraPos.xyz; }
