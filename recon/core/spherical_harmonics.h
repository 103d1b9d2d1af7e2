// Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS.
#pragma once

#include "simd.h"

namespace core {

constexpr float kSh0 = 0.28209479177387814f;
constexpr float kSh1 = 0.4886025119029199f;
constexpr float kSh2[] = {1.0925484305920792f, 0.31539156525252005f, 0.5462742152960396f};
constexpr float kSh3[] = {0.5900435899266435f, 2.890611442640554f, 0.4570457994644658f, 0.3731763325901154f,
                          1.445305721320277f};

// basis[0..bases) at the unit vector (x, y, z).
inline void sh_basis(int bases, Vec x, Vec y, Vec z, Vec* basis) {
    basis[0] = splat(kSh0);
    if (bases <= 1) return;
    basis[1] = -kSh1 * y, basis[2] = kSh1 * z, basis[3] = -kSh1 * x;
    if (bases <= 4) return;
    const Vec xx = x * x, yy = y * y, zz = z * z;
    basis[4] = kSh2[0] * x * y;
    basis[5] = -kSh2[0] * y * z;
    basis[6] = kSh2[1] * (2.0f * zz - xx - yy);
    basis[7] = -kSh2[0] * x * z;
    basis[8] = kSh2[2] * (xx - yy);
    if (bases <= 9) return;
    basis[9] = -kSh3[0] * y * (3.0f * xx - yy);
    basis[10] = kSh3[1] * x * y * z;
    basis[11] = -kSh3[2] * y * (4.0f * zz - xx - yy);
    basis[12] = kSh3[3] * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
    basis[13] = -kSh3[2] * x * (4.0f * zz - xx - yy);
    basis[14] = kSh3[4] * z * (xx - yy);
    basis[15] = -kSh3[0] * x * (xx - 3.0f * yy);
}

// The gradient of sum over i of factors[i] * basis[i] with respect to (x, y, z).
inline void sh_gradient(int bases, Vec x, Vec y, Vec z, const Vec* factors, Vec (&gradient)[3]) {
    Vec gx{}, gy{}, gz{};
    if (bases > 1) {
        gx -= kSh1 * factors[3], gy -= kSh1 * factors[1], gz += kSh1 * factors[2];
    }
    if (bases > 4) {
        const Vec f4 = kSh2[0] * factors[4], f5 = kSh2[0] * factors[5], f6 = 2.0f * kSh2[1] * factors[6];
        const Vec f7 = kSh2[0] * factors[7], f8 = 2.0f * kSh2[2] * factors[8];
        gx += f4 * y - f6 * x - f7 * z + f8 * x;
        gy += f4 * x - f5 * z - f6 * y - f8 * y;
        gz += 2.0f * f6 * z - f5 * y - f7 * x;
    }
    if (bases > 9) {
        const Vec xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
        const Vec f9 = kSh3[0] * factors[9], f10 = kSh3[1] * factors[10], f11 = kSh3[2] * factors[11];
        const Vec f12 = kSh3[3] * factors[12], f13 = kSh3[2] * factors[13], f14 = kSh3[4] * factors[14];
        const Vec f15 = kSh3[0] * factors[15];
        gx += -6.0f * f9 * xy + f10 * yz + 2.0f * f11 * xy - 6.0f * f12 * xz - f13 * (4.0f * zz - 3.0f * xx - yy) +
              2.0f * f14 * xz - 3.0f * f15 * (xx - yy);
        gy += -3.0f * f9 * (xx - yy) + f10 * xz - f11 * (4.0f * zz - xx - 3.0f * yy) - 6.0f * f12 * yz +
              2.0f * f13 * xy - 2.0f * f14 * yz + 6.0f * f15 * xy;
        gz += f10 * xy - 8.0f * f11 * yz + f12 * (6.0f * zz - 3.0f * xx - 3.0f * yy) - 8.0f * f13 * xz +
              f14 * (xx - yy);
    }
    gradient[0] = gx, gradient[1] = gy, gradient[2] = gz;
}

}  // namespace core
