// Matrices of 3 x 3 for the bundle adjustment: inverse, product with a vector, rotation.
#pragma once

#include <algorithm>
#include <cmath>

namespace core {
namespace {

constexpr double kSingular = 1e-300;  // least absolute determinant of a matrix that is inverted
constexpr double kSmallAngle = 1e-8;  // radians, below which the series' first terms are exact in double

// False when the symmetric matrix (3, 3) is not invertible.
bool invert(const double m[3][3], double inverse[3][3]) {
    const double a = m[1][1] * m[2][2] - m[1][2] * m[2][1];
    const double b = m[1][2] * m[2][0] - m[1][0] * m[2][2];
    const double c = m[1][0] * m[2][1] - m[1][1] * m[2][0];
    const double determinant = m[0][0] * a + m[0][1] * b + m[0][2] * c;
    if (!(std::abs(determinant) > kSingular)) return false;
    const double d = 1 / determinant;
    inverse[0][0] = a * d;
    inverse[0][1] = inverse[1][0] = b * d;
    inverse[0][2] = inverse[2][0] = c * d;
    inverse[1][1] = (m[0][0] * m[2][2] - m[0][2] * m[2][0]) * d;
    inverse[1][2] = inverse[2][1] = (m[0][2] * m[1][0] - m[0][0] * m[1][2]) * d;
    inverse[2][2] = (m[0][0] * m[1][1] - m[0][1] * m[1][0]) * d;
    return true;
}

inline void multiply(const double m[3][3], const double* vector, double* product) {
    for (int i = 0; i < 3; ++i) product[i] = m[i][0] * vector[0] + m[i][1] * vector[1] + m[i][2] * vector[2];
}

// Rodrigues' formula, applied from the left.
void turn(double* rotation, const double* vector) {
    const double x = vector[0], y = vector[1], z = vector[2];
    const double angle = std::sqrt(x * x + y * y + z * z);
    const double first = angle < kSmallAngle ? 1.0 : std::sin(angle) / angle;
    const double second = angle < kSmallAngle ? 0.5 : (1 - std::cos(angle)) / (angle * angle);
    const double by[3][3] = {{1 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y},
                             {second * x * y + first * z, 1 - second * (x * x + z * z), second * y * z - first * x},
                             {second * x * z - first * y, second * y * z + first * x, 1 - second * (x * x + y * y)}};
    double turned[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            turned[3 * i + j] = by[i][0] * rotation[j] + by[i][1] * rotation[3 + j] + by[i][2] * rotation[6 + j];
    std::copy(turned, turned + 9, rotation);
}

}  // namespace
}  // namespace core
