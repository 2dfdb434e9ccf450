#version 450
// variants: CHANNELS=4,7,12,16,20
// subgroups: 4,8,16,32,64
// Gradients by the screen-space splats, stored per entry of the tile lists.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#define BY_ENTRY 1
#include "shared/raster_backward.glsl"
