// What Caster.hlsl takes of URP.
float4x4 unity_MatrixVP;
#define UNITY_MATRIX_VP unity_MatrixVP
