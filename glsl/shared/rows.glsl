// Number of a thread in a dispatch of rows of workgroups: some devices allow no more than 65535
// workgroups along one dimension.

uint thread_number() {
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    return group * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
}
