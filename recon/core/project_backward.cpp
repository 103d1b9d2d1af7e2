// Stage 5: every Gaussian gathers its slots and follows the projection back to its parameters and the camera.
#include <algorithm>
#include <cstring>

#include "projection.h"
#include "spherical_harmonics.h"
#include "threads.h"

namespace core {
namespace {

constexpr float kInverseScale = 1.17741002251547f;  // sqrt(2 / log2(e)): from u, w to a, b of Projection
constexpr int kCameraSums = 16;                     // rotation 9, centre 3, focal 2, principal 2
constexpr int kFlushEvery = 16;                     // registers of Gaussians summed in float before they go to double

// The gradient of the splats of kLanes Gaussians.
struct SplatLanes {
    Vec v;           // sum of dL/d(ln alpha)
    Vec a, b;        // times a, b, a^2, a b, b^2
    Vec aa, ab, bb;
    Vec colour[3], depth, normal[3];
};

// Sums the slots of each Gaussian, in the order of its tiles. `slots` moves on to those of the next Gaussians.
SplatLanes gather(const Raster& raster, int first, int valid, const SplatGradient*& slots) {
    constexpr int kParts = 16 / kLanes;
    alignas(64) float rows[kLanes][16] = {};
    const float* row_starts[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) row_starts[lane] = rows[lane];
    for (int lane = 0; lane < valid; ++lane) {
        const SplatGradient* end = slots + raster.rects[first + lane].count();
        Vec sums[kParts] = {};
        for (; slots < end; ++slots)
            for (int part = 0; part < kParts; ++part) sums[part] += load(slots->moments + part * kLanes);
        for (int part = 0; part < kParts; ++part) store(rows[lane] + part * kLanes, sums[part]);
    }
    Vec columns[16];
    load_transposed(row_starts, columns);
    SplatLanes g;
    g.v = columns[0];
    g.a = columns[1] * kInverseScale, g.b = columns[2] * kInverseScale;
    constexpr float kSquare = kInverseScale * kInverseScale;
    g.aa = columns[3] * kSquare, g.ab = columns[4] * kSquare, g.bb = columns[5] * kSquare;
    for (int c = 0; c < 3; ++c) g.colour[c] = columns[8 + c];
    g.depth = columns[11];
    for (int c = 0; c < 3; ++c) g.normal[c] = columns[12 + c];
    return g;
}

struct GaussianGradients {
    Vec mean[3], quat[4], scale[3], opacity[1];
};

// Gradient of the colours: writes that of the coefficients, adds that of the direction to `to_mean`.
void colours_backward(const RasterInput& input, const Raster& raster, int first, int valid, unsigned seen,
                      const Projection& p, const SplatLanes& g, float* sh_gradients, Vec (&to_mean)[3]) {
    const int bases = input.sh_bases;
    // A colour that was cut off at 0 has no gradient.
    alignas(64) float colours[3][kLanes] = {};
    for (int lane = 0; lane < valid; ++lane)
        for (int c = 0; c < 3; ++c)
            if (seen >> lane & 1) colours[c][lane] = raster.splats[first + lane].features[c];
    Vec gradient[3];
    for (int c = 0; c < 3; ++c) gradient[c] = keep(less(Vec{}, load(colours[c])), g.colour[c]);

    const Vec inverse = 1.0f / square_root(dot(p.to_mean, p.to_mean));
    const Vec direction[3] = {p.to_mean[0] * inverse, p.to_mean[1] * inverse, p.to_mean[2] * inverse};
    Vec basis[16], factors[16];
    sh_basis(bases, direction[0], direction[1], direction[2], basis);
    const size_t row = size_t(bases) * 3;
    for (int i = 0; i < bases; ++i) {
        alignas(64) float products[3][kLanes];
        for (int c = 0; c < 3; ++c) store(products[c], basis[i] * gradient[c]);
        for (int lane = 0; lane < valid; ++lane)
            for (int c = 0; c < 3; ++c)
                sh_gradients[(first + lane) * row + 3 * i + c] = seen >> lane & 1 ? products[c][lane] : 0.0f;
    }
    if (bases == 1) return;
    for (int i = 0; i < bases; ++i) {
        alignas(64) float coefficients[3][kLanes];
        for (int lane = 0; lane < kLanes; ++lane)
            for (int c = 0; c < 3; ++c)
                coefficients[c][lane] = input.sh[(first + std::min(lane, valid - 1)) * row + 3 * i + c];
        factors[i] = Vec{};
        for (int c = 0; c < 3; ++c) factors[i] += load(coefficients[c]) * gradient[c];
    }
    Vec toward[3];
    sh_gradient(bases, direction[0], direction[1], direction[2], factors, toward);
    const Vec along = dot(direction, toward);
    for (int i = 0; i < 3; ++i) to_mean[i] += (toward[i] - along * direction[i]) * inverse;
}

// Gradient of the unit quaternion's matrix `axes`, taken to the quaternion as it was given.
void quat_backward(const Projection& p, const Vec (&axes)[3][3], Vec (&gradient)[4]) {
    const Vec w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3];
    const Vec(&d)[3][3] = axes;
    const Vec turn_x = d[2][1] - d[1][2], turn_y = d[0][2] - d[2][0], turn_z = d[1][0] - d[0][1];
    const Vec xy = d[0][1] + d[1][0], xz = d[0][2] + d[2][0], yz = d[1][2] + d[2][1];
    const Vec unit[4] = {
        2.0f * (x * turn_x + y * turn_y + z * turn_z),
        2.0f * (w * turn_x + y * xy + z * xz - 2.0f * x * (d[1][1] + d[2][2])),
        2.0f * (w * turn_y + x * xy + z * yz - 2.0f * y * (d[0][0] + d[2][2])),
        2.0f * (w * turn_z + x * xz + y * yz - 2.0f * z * (d[0][0] + d[1][1])),
    };
    const Vec along = w * unit[0] + x * unit[1] + y * unit[2] + z * unit[3];
    for (int i = 0; i < 4; ++i) gradient[i] = (unit[i] - along * p.quat[i]) * p.inverse_norm;
}

// The gradients of kLanes Gaussians, and their part in the camera's. Lanes that are not seen get rubbish.
GaussianGradients projection_backward(const Gaussians& gaussians, const Projection& p, const SplatLanes& g,
                                      const Camera& camera, bool antialias, Vec (&to_mean)[3],
                                      Vec (&camera_sums)[kCameraSums]) {
    GaussianGradients out;
    out.opacity[0] = g.v / gaussians.opacity[0];

    // Centre: a and b depend on the pixel's offset from it.
    const Vec centre_x = p.factor_x * g.a, centre_y = p.factor_y * g.b - p.slope * centre_x;

    // Covariance = rows rows^T + low pass. With F the factor that gives (a, b) = F offset, the gradient of the rows is
    // F^T M F rows, M = [[aa, ab], [ab, bb]]; antialiasing adds the determinant's part.
    const Vec aa = antialias ? g.aa - g.v : g.aa, bb = antialias ? g.bb - g.v : g.bb;
    Vec rows[2][3];
    for (int k = 0; k < 3; ++k) {
        const Vec a = p.factor_x * (p.rows[0][k] - p.slope * p.rows[1][k]), b = p.factor_y * p.rows[1][k];
        const Vec ma = p.factor_x * (aa * a + g.ab * b), mb = p.factor_y * (g.ab * a + bb * b);
        rows[0][k] = ma;
        rows[1][k] = mb - p.slope * ma;
    }
    if (antialias) {
        Vec from_first[3], from_second[3];
        cross(p.rows[1], p.normal_to_rows, from_first);
        cross(p.normal_to_rows, p.rows[0], from_second);
        const Vec factor = g.v / p.area2;
        for (int k = 0; k < 3; ++k) rows[0][k] += factor * from_first[k], rows[1][k] += factor * from_second[k];
    }

    // Rows: focal/z * (axis_x - x/z axis_z) * scale, and the same in y.
    Vec axes_camera[3][3], x_by_z = centre_x * camera.fx, y_by_z = centre_y * camera.fy, focal_x{}, focal_y{};
    for (int k = 0; k < 3; ++k) {
        const Vec along_z = p.axes_camera[2][k], scale = gaussians.scale[k];
        const Vec bare_x = p.axes_camera[0][k] - p.x_by_z * along_z, bare_y = p.axes_camera[1][k] - p.y_by_z * along_z;
        out.scale[k] = rows[0][k] * p.focal_x * bare_x + rows[1][k] * p.focal_y * bare_y;
        focal_x += rows[0][k] * bare_x * scale, focal_y += rows[1][k] * bare_y * scale;
        const Vec axis_x = rows[0][k] * p.focal_x * scale, axis_y = rows[1][k] * p.focal_y * scale;
        axes_camera[0][k] = axis_x, axes_camera[1][k] = axis_y;
        axes_camera[2][k] = -p.x_by_z * axis_x - p.y_by_z * axis_y;
        x_by_z -= axis_x * along_z, y_by_z -= axis_y * along_z;
    }
    Vec sign[3];
    choose_normal(gaussians, p, sign);
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) axes_camera[i][k] += sign[k] * g.normal[i];

    // Position in the camera frame.
    const Vec along_ray = p.x_by_z * x_by_z + p.y_by_z * y_by_z + p.focal_x * focal_x + p.focal_y * focal_y;
    const Vec in_camera[3] = {x_by_z * p.inverse_z, y_by_z * p.inverse_z, g.depth - along_ray * p.inverse_z};
    const float(&R)[3][3] = camera.rotation;
    for (int j = 0; j < 3; ++j) {
        to_mean[j] += in_camera[0] * R[0][j] + in_camera[1] * R[1][j] + in_camera[2] * R[2][j];
        out.mean[j] = to_mean[j];
    }

    // Rotation of the Gaussian and of the camera: axes_camera = rotation axes_world.
    Vec axes_world[3][3];
    for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k)
            axes_world[j][k] = axes_camera[0][k] * R[0][j] + axes_camera[1][k] * R[1][j] + axes_camera[2][k] * R[2][j];
    quat_backward(p, axes_world, out.quat);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            camera_sums[3 * i + j] = in_camera[i] * p.to_mean[j] + dot(axes_camera[i], p.axes_world[j]);
    for (int j = 0; j < 3; ++j) camera_sums[9 + j] = -to_mean[j];
    camera_sums[12] = centre_x * p.x_by_z + focal_x * p.inverse_z;
    camera_sums[13] = centre_y * p.y_by_z + focal_y * p.inverse_z;
    camera_sums[14] = centre_x, camera_sums[15] = centre_y;
    return out;
}

// Zeros for Gaussians [first, first + valid), of which none is seen.
void clear_gradients(const RasterInput& input, int first, int valid, RasterGradients& gradients) {
    std::memset(gradients.means + 3 * size_t(first), 0, sizeof(float) * 3 * valid);
    std::memset(gradients.quats + 4 * size_t(first), 0, sizeof(float) * 4 * valid);
    std::memset(gradients.scales + 3 * size_t(first), 0, sizeof(float) * 3 * valid);
    std::memset(gradients.opacities + first, 0, sizeof(float) * valid);
    const size_t row = size_t(input.sh_bases) * 3;
    std::memset(gradients.sh + row * first, 0, sizeof(float) * row * valid);
}

void differentiate_chunk(const RasterInput& input, const Raster& raster, int chunk, RasterGradients& gradients,
                         double* camera_sums) {
    const int begin = chunk * raster.chunk, end = std::min(raster.num_gaussians, begin + raster.chunk);
    const SplatGradient* slots = raster.slots.data() + raster.chunk_slots[chunk];
    Vec sums[kCameraSums] = {};
    const auto flush = [&] {
        for (int i = 0; i < kCameraSums; ++i) {
            for (int lane = 0; lane < kLanes; ++lane) camera_sums[i] += sums[i][lane];
            sums[i] = Vec{};
        }
    };
    int since_flush = 0;
    for (int first = begin; first < end; first += kLanes) {
        const int valid = std::min(kLanes, end - first);
        alignas(64) float flags[kLanes] = {};
        for (int lane = 0; lane < valid; ++lane) flags[lane] = raster.rects[first + lane].count() ? 1.0f : 0.0f;
        const Mask seen_lanes = less(Vec{}, load(flags));
        const unsigned seen = bits(seen_lanes);
        if (!seen) {
            clear_gradients(input, first, valid, gradients);
            continue;
        }
        const Gaussians gaussians = load_gaussians(input, first, valid);
        const Projection p = project_gaussians(gaussians, raster.camera, input.antialias);
        const SplatLanes g = gather(raster, first, valid, slots);
        Vec to_mean[3] = {};
        colours_backward(input, raster, first, valid, seen, p, g, gradients.sh, to_mean);
        Vec camera_part[kCameraSums];
        GaussianGradients out =
            projection_backward(gaussians, p, g, raster.camera, input.antialias, to_mean, camera_part);
        for (Vec& value : out.mean) value = keep(seen_lanes, value);
        for (Vec& value : out.quat) value = keep(seen_lanes, value);
        for (Vec& value : out.scale) value = keep(seen_lanes, value);
        out.opacity[0] = keep(seen_lanes, out.opacity[0]);
        store_rows(gradients.means + 3 * size_t(first), valid, out.mean);
        store_rows(gradients.quats + 4 * size_t(first), valid, out.quat);
        store_rows(gradients.scales + 3 * size_t(first), valid, out.scale);
        store_rows(gradients.opacities + first, valid, out.opacity);
        for (int i = 0; i < kCameraSums; ++i) sums[i] += keep(seen_lanes, camera_part[i]);
        if (++since_flush % kFlushEvery == 0) flush();
    }
    flush();
}

}  // namespace

void project_backward(const RasterInput& input, Raster& raster, RasterGradients& gradients) {
    double* camera_sums = raster.camera_sums.resize(size_t(raster.num_chunks) * kCameraSums);
    run_parallel(raster.num_chunks, [&](int chunk, int) {
        double* sums = camera_sums + size_t(chunk) * kCameraSums;
        std::fill(sums, sums + kCameraSums, 0.0);
        differentiate_chunk(input, raster, chunk, gradients, sums);
    });

    double total[kCameraSums] = {};
    for (int chunk = 0; chunk < raster.num_chunks; ++chunk)
        for (int i = 0; i < kCameraSums; ++i) total[i] += camera_sums[size_t(chunk) * kCameraSums + i];
    std::fill(gradients.T_world_camera, gradients.T_world_camera + 16, 0.0);
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) gradients.T_world_camera[4 * j + i] = total[3 * i + j];
        gradients.T_world_camera[4 * i + 3] = total[9 + i];
    }
    for (int i = 0; i < 2; ++i) gradients.focal[i] = total[12 + i], gradients.principal[i] = total[14 + i];
}

}  // namespace core
