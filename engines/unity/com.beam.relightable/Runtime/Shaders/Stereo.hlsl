// Single-pass instanced stereo: an eye is an instance, and a slice of every target. Unity sets the keyword.

#ifndef BEAM_STEREO
#define BEAM_STEREO

#if defined(STEREO_INSTANCING_ON)
#define BEAM_EYE_INPUT , uint instance : SV_InstanceID
#define BEAM_EYE (instance & 1u)
#define BEAM_EYE_OUTPUT uint slice : SV_RenderTargetArrayIndex;
#define BEAM_SET_EYE(output, eye) output.slice = eye;
#else
#define BEAM_EYE_INPUT
#define BEAM_EYE 0u
#define BEAM_EYE_OUTPUT
#define BEAM_SET_EYE(output, eye)
#endif

#endif
