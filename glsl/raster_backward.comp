#version 450
// variants: CHANNELS=4,7,12,16,20
// subgroups: 4,8,16,32,64
// Gradients by the screen-space splats, summed by float atomics.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "gpu/atomic_float.glsl"
#define BY_ENTRY 0
#include "shared/raster_backward.glsl"
