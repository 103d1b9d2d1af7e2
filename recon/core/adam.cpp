// Adam over all parameters of a scene in one call ("Adam", Kingma and Ba 2015, algorithm 1).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "threads.h"

namespace core {
namespace {

constexpr int64_t kPiece = 16384;  // numbers of a task

struct AdamGroup {
    float *parameter, *first, *second;
    const float* gradient;
    const float* row_factors;  // of the learning rate, one per row; null: all 1
    int64_t count, row_size;
    float step_size;       // learning rate / (1 - beta1^t)
    float root_correction;  // 1 / sqrt(1 - beta2^t)
};

struct Update {
    float beta1, rest1, beta2, rest2, epsilon;  // rest = 1 - beta, which in float has lost its digits
};

inline void update_range(const AdamGroup& group, const Update& u, int64_t begin, int64_t end, float step_size) {
    float *__restrict p = group.parameter, *__restrict m = group.first, *__restrict v = group.second;
    const float* __restrict g = group.gradient;
    const float root_correction = group.root_correction;
    for (int64_t i = begin; i < end; ++i) {
        const float first = u.beta1 * m[i] + u.rest1 * g[i];
        const float second = u.beta2 * v[i] + u.rest2 * g[i] * g[i];
        m[i] = first;
        v[i] = second;
        p[i] -= step_size * first / (std::sqrt(second) * root_correction + u.epsilon);
    }
}

void update_piece(const AdamGroup& group, const Update& u, int64_t begin, int64_t end) {
    if (!group.row_factors) return update_range(group, u, begin, end, group.step_size);
    for (int64_t row = begin / group.row_size; row * group.row_size < end; ++row)
        update_range(group, u, std::max(begin, row * group.row_size), std::min(end, (row + 1) * group.row_size),
                     group.step_size * group.row_factors[row]);
}

}  // namespace
}  // namespace core

using namespace core;

CORE_API void core_adam(const AdamGroup* groups, int num_groups, double beta1, double beta2, double epsilon) {
    const Update update = {float(beta1), float(1 - beta1), float(beta2), float(1 - beta2), float(epsilon)};
    struct Piece {
        int group;
        int64_t begin;
    };
    std::vector<Piece> pieces;
    for (int group = 0; group < num_groups; ++group)
        for (int64_t begin = 0; begin < groups[group].count; begin += kPiece) pieces.push_back({group, begin});
    run_parallel(int(pieces.size()), [&](int index, int) {
        const AdamGroup& group = groups[pieces[index].group];
        const int64_t begin = pieces[index].begin;
        update_piece(group, update, begin, std::min(begin + kPiece, group.count));
    });
}
