// Caster.hlsl takes nothing of it; what HDRP has stands beside.
