// The projection of kLanes Gaussians at a time, shared by the way there and the way back.
#pragma once

#include "rasterize.h"

namespace core {

// Columns of kLanes rows of `Columns` floats; rows from `valid` on repeat the last one.
template <int Columns>
inline void load_rows(const float* rows, int valid, Vec (&columns)[Columns]) {
    alignas(64) float transposed[Columns][kLanes];
    if (valid == kLanes) {  // with a fixed stride the compiler loads registers and permutes them
        for (int lane = 0; lane < kLanes; ++lane)
            for (int column = 0; column < Columns; ++column) transposed[column][lane] = rows[lane * Columns + column];
    } else {
        for (int lane = 0; lane < kLanes; ++lane)
            for (int column = 0; column < Columns; ++column)
                transposed[column][lane] = rows[(lane < valid ? lane : valid - 1) * Columns + column];
    }
    for (int column = 0; column < Columns; ++column) columns[column] = load(transposed[column]);
}

template <int Columns>
inline void store_rows(float* rows, int valid, const Vec (&columns)[Columns]) {
    alignas(64) float transposed[Columns][kLanes];
    for (int column = 0; column < Columns; ++column) store(transposed[column], columns[column]);
    const int count = valid == kLanes ? kLanes : valid;
    for (int lane = 0; lane < count; ++lane)
        for (int column = 0; column < Columns; ++column) rows[lane * Columns + column] = transposed[column][lane];
}

struct Gaussians {
    Vec mean[3], quat[4], scale[3], opacity[1];
};

inline Gaussians load_gaussians(const RasterInput& input, int first, int valid) {
    Gaussians gaussians;
    load_rows(input.means + 3 * size_t(first), valid, gaussians.mean);
    load_rows(input.quats + 4 * size_t(first), valid, gaussians.quat);
    load_rows(input.scales + 3 * size_t(first), valid, gaussians.scale);
    load_rows(input.opacities + first, valid, gaussians.opacity);
    return gaussians;
}

// Everything between a Gaussian and its splat that the gradient needs as well.
struct Projection {
    Vec to_mean[3];         // from the camera's centre, world axes
    Vec inverse_norm;       // 1 / |quat|
    Vec quat[4];            // of unit length
    Vec axes_world[3][3];   // [row][k]: the k-th axis of the Gaussian
    Vec axes_camera[3][3];
    Vec x, y, z, inverse_z;
    Vec x_by_z, y_by_z;
    Vec focal_x, focal_y;   // fx / z, fy / z
    Vec rows[2][3];         // the scaled axes on the image: covariance = rows * rows^T + low pass
    Vec normal_to_rows[3];  // rows[0] x rows[1]; its squared length is the covariance's determinant before the low pass
    Vec area2;              // that squared length
    Vec xx, yy, slope;      // covariance: variances, and covariance over yy
    // a = factor_x * (dx - slope * dy), b = factor_y * dy, alpha = opacity * exp(-(a^2 + b^2) / 2)
    Vec factor_x, factor_y;
    Vec compensation;       // of the opacity for the low pass; 1 without antialiasing
};

inline Vec dot(const Vec (&a)[3], const Vec (&b)[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline void cross(const Vec (&a)[3], const Vec (&b)[3], Vec (&product)[3]) {
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        product[i] = a[j] * b[k] - a[k] * b[j];
    }
}

inline Projection project_gaussians(const Gaussians& gaussians, const Camera& camera, bool antialias) {
    Projection p;
    for (int i = 0; i < 3; ++i) p.to_mean[i] = gaussians.mean[i] - camera.centre[i];
    Vec in_camera[3];
    for (int i = 0; i < 3; ++i) {
        const float* row = camera.rotation[i];
        in_camera[i] = p.to_mean[0] * row[0] + p.to_mean[1] * row[1] + p.to_mean[2] * row[2];
    }
    p.x = in_camera[0], p.y = in_camera[1], p.z = in_camera[2];

    const Vec(&q)[4] = gaussians.quat;
    p.inverse_norm = 1.0f / square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; ++i) p.quat[i] = q[i] * p.inverse_norm;
    const Vec w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3];
    p.axes_world[0][0] = 1.0f - 2.0f * (y * y + z * z);
    p.axes_world[0][1] = 2.0f * (x * y - w * z);
    p.axes_world[0][2] = 2.0f * (x * z + w * y);
    p.axes_world[1][0] = 2.0f * (x * y + w * z);
    p.axes_world[1][1] = 1.0f - 2.0f * (x * x + z * z);
    p.axes_world[1][2] = 2.0f * (y * z - w * x);
    p.axes_world[2][0] = 2.0f * (x * z - w * y);
    p.axes_world[2][1] = 2.0f * (y * z + w * x);
    p.axes_world[2][2] = 1.0f - 2.0f * (x * x + y * y);

    p.inverse_z = 1.0f / p.z;
    p.x_by_z = p.x * p.inverse_z, p.y_by_z = p.y * p.inverse_z;
    p.focal_x = p.inverse_z * camera.fx, p.focal_y = p.inverse_z * camera.fy;
    for (int k = 0; k < 3; ++k) {
        for (int i = 0; i < 3; ++i) {
            const float* row = camera.rotation[i];
            const Vec(&axes)[3][3] = p.axes_world;
            p.axes_camera[i][k] = axes[0][k] * row[0] + axes[1][k] * row[1] + axes[2][k] * row[2];
        }
        p.rows[0][k] = p.focal_x * (p.axes_camera[0][k] - p.x_by_z * p.axes_camera[2][k]) * gaussians.scale[k];
        p.rows[1][k] = p.focal_y * (p.axes_camera[1][k] - p.y_by_z * p.axes_camera[2][k]) * gaussians.scale[k];
    }

    const Vec xx = dot(p.rows[0], p.rows[0]), xy = dot(p.rows[0], p.rows[1]), yy = dot(p.rows[1], p.rows[1]);
    cross(p.rows[0], p.rows[1], p.normal_to_rows);
    p.area2 = dot(p.normal_to_rows, p.normal_to_rows);
    p.xx = xx + kLowPass, p.yy = yy + kLowPass;
    // xx * yy - xy * xy cancels for thin splats; this sum has only positive terms.
    const Vec determinant = p.area2 + kLowPass * (xx + yy) + kLowPass * kLowPass;
    p.slope = xy / p.yy;
    p.factor_x = square_root(p.yy / determinant);
    p.factor_y = 1.0f / square_root(p.yy);
    p.compensation = antialias ? square_root(p.area2 / determinant) : splat(1.0f);
    return p;
}

// The normal is the axis of least scale (of equal ones the first): 1 in that lane and column, turned to the camera.
inline void choose_normal(const Gaussians& gaussians, const Projection& p, Vec (&sign)[3]) {
    const Vec(&s)[3] = gaussians.scale;
    const Vec one = splat(1.0f), zero = Vec{};
    const Vec first = select(at_least(s[1], s[0]), select(at_least(s[2], s[0]), one, zero), zero);
    const Vec second = select(at_least(s[2], s[1]), one - first, zero);
    const Vec third = one - first - second;
    const Vec chosen[3] = {first, second, third};
    for (int k = 0; k < 3; ++k) {
        const Vec away = p.axes_camera[0][k] * p.x + p.axes_camera[1][k] * p.y + p.axes_camera[2][k] * p.z;
        sign[k] = select(less(Vec{}, away), -chosen[k], chosen[k]);
    }
}

}  // namespace core
