// Real spherical harmonics up to SH_DEGREE (order and signs of all 3DGS files). Reference:
// pass::sh.
#define SH_COUNT ((SH_DEGREE + 1) * (SH_DEGREE + 1))

void sh_basis(vec3 d, out float b[SH_COUNT]) {
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    b[0] = 0.28209479177387814;
#if SH_DEGREE >= 1
    b[1] = -0.4886025119029199 * y;
    b[2] = 0.4886025119029199 * z;
    b[3] = -0.4886025119029199 * x;
#endif
#if SH_DEGREE >= 2
    b[4] = 1.0925484305920792 * x * y;
    b[5] = -1.0925484305920792 * y * z;
    b[6] = 0.31539156525252005 * (2.0 * zz - xx - yy);
    b[7] = -1.0925484305920792 * x * z;
    b[8] = 0.5462742152960396 * (xx - yy);
#endif
#if SH_DEGREE >= 3
    b[9] = -0.5900435899266435 * y * (3.0 * xx - yy);
    b[10] = 2.890611442640554 * x * y * z;
    b[11] = -0.4570457994644658 * y * (4.0 * zz - xx - yy);
    b[12] = 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
    b[13] = -0.4570457994644658 * x * (4.0 * zz - xx - yy);
    b[14] = 1.445305721320277 * z * (xx - yy);
    b[15] = -0.5900435899266435 * x * (xx - 3.0 * yy);
#endif
}

// Derivatives of the basis by the direction, with its components as free variables.
void sh_basis_gradient(vec3 d, out vec3 g[SH_COUNT]) {
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    g[0] = vec3(0);
#if SH_DEGREE >= 1
    g[1] = vec3(0.0, -0.4886025119029199, 0.0);
    g[2] = vec3(0.0, 0.0, 0.4886025119029199);
    g[3] = vec3(-0.4886025119029199, 0.0, 0.0);
#endif
#if SH_DEGREE >= 2
    g[4] = 1.0925484305920792 * vec3(y, x, 0.0);
    g[5] = -1.0925484305920792 * vec3(0.0, z, y);
    g[6] = 0.31539156525252005 * vec3(-2.0 * x, -2.0 * y, 4.0 * z);
    g[7] = -1.0925484305920792 * vec3(z, 0.0, x);
    g[8] = 0.5462742152960396 * vec3(2.0 * x, -2.0 * y, 0.0);
#endif
#if SH_DEGREE >= 3
    g[9] = -0.5900435899266435 * vec3(6.0 * x * y, 3.0 * (xx - yy), 0.0);
    g[10] = 2.890611442640554 * vec3(y * z, x * z, x * y);
    g[11] = -0.4570457994644658 * vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z);
    g[12] = 0.3731763325901154 * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy);
    g[13] = -0.4570457994644658 * vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z);
    g[14] = 1.445305721320277 * vec3(2.0 * x * z, -2.0 * y * z, xx - yy);
    g[15] = -0.5900435899266435 * vec3(3.0 * (xx - yy), -6.0 * x * y, 0.0);
#endif
}
