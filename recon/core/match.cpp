// The two nearest of 8-bit descriptors and the way back, fused with the products: no matrix of distances is kept.
//
// A register holds four bytes of each of several descriptors of the second set ("panel"); four bytes of one descriptor
// of the first set are broadcast to all its lanes.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "descriptors.h"
#include "threads.h"

namespace core {
namespace {

constexpr int kSteps = kSize / 4;  // registers of a panel
constexpr int kRows = 4;           // descriptors of the first set whose sums are held in registers
constexpr int kPanels = 2;         // panels of the second set with them
constexpr int kRowsPerTask = 48;

inline IntVec larger(IntVec a, IntVec b) { return a > b ? a : b; }
inline IntVec smaller(IntVec a, IntVec b) { return a < b ? a : b; }

// The second set in panels of kLanes descriptors, and what turns a dot product into a score.
struct Panels {
    int count, num_panels;
    std::vector<int32_t> bytes;   // [panel][step][lane], four bytes each; from the first multiple of the register's size
    std::vector<int32_t> offset;  // [panel][lane]: kOffset - |b|^2 / 2; far below 0 where there is no descriptor
    const int32_t* aligned;

    Panels(const uint8_t* descriptors, int count) : count(count) {
        num_panels = (count + kLanes - 1) / kLanes;
        num_panels += num_panels % kPanels;
        bytes.assign(size_t(num_panels) * kSteps * kLanes + kLanes, 0);
        offset.assign(size_t(num_panels) * kLanes, -(1 << 14) - kOffset);
        const size_t past = reinterpret_cast<uintptr_t>(bytes.data()) % sizeof(IntVec) / 4;
        int32_t* to = bytes.data() + (past ? kLanes - past : 0);
        aligned = to;
        for (int i = 0; i < count; ++i) {
            const uint8_t* from = descriptors + size_t(i) * kSize;
            offset[i] = kOffset - half_norm(from);
            int32_t* panel = to + size_t(i / kLanes) * kSteps * kLanes + i % kLanes;
            for (int step = 0; step < kSteps; ++step) std::memcpy(panel + step * kLanes, from + 4 * step, 4);
        }
    }
};

struct Result {
    int32_t *nearest, *score, *second_score, *back;
};

// The rows [begin, end) of the first set against all of the second. `column_best` is this thread's best row a column.
void match_rows(const uint8_t* first, const int32_t* half_norms, int begin, int end, const Panels& panels,
                IntVec* column_best, const Result& result) {
    IntVec best[kRowsPerTask], second[kRowsPerTask];
    for (int row = 0; row < kRowsPerTask; ++row) best[row] = second[row] = IntVec{};
    IntVec lane;
    for (int i = 0; i < kLanes; ++i) lane[i] = 0xffff - i;
    for (int panel = 0; panel < panels.num_panels; panel += kPanels) {
        const IntVec* b = reinterpret_cast<const IntVec*>(panels.aligned) + size_t(panel) * kSteps;
        for (int row = begin; row < end; row += kRows) {
            int32_t a[kRows][kSteps];
            for (int r = 0; r < kRows; ++r) std::memcpy(a[r], first + size_t(std::min(row + r, end - 1)) * kSize, kSize);
            Sums sums[kRows][kPanels] = {};
            for (int step = 0; step < kSteps; ++step)
                for (int r = 0; r < kRows; ++r)
                    for (int p = 0; p < kPanels; ++p)
                        sums[r][p] = multiply_add(sums[r][p], IntVec{} + a[r][step], b[p * kSteps + step]);
            for (int p = 0; p < kPanels; ++p) {
                IntVec offset;
                std::memcpy(&offset, &panels.offset[size_t(panel + p) * kLanes], sizeof offset);
                const IntVec index = lane - (panel + p) * kLanes;
                IntVec column = column_best[panel + p];
                for (int r = 0; r < kRows; ++r) {
                    const int at = std::min(row + r, end - 1);
                    const IntVec dot = dot_products(sums[r][p]);
                    const IntVec score = larger(dot + offset, IntVec{});
                    if (row + r < end) {
                        const IntVec packed = (score << 16) + index;
                        IntVec& winner = best[at - begin];
                        second[at - begin] = larger(second[at - begin], smaller(winner, packed));
                        winner = larger(winner, packed);
                    }
                    // Back, the best row of a column is that with the largest dot - |a|^2 / 2.
                    const IntVec back = larger(dot + (kOffset - half_norms[at]), IntVec{});
                    column = larger(column, (back << 16) + (0xffff - at));
                }
                column_best[panel + p] = column;
            }
        }
    }
    for (int row = begin; row < end; ++row) {
        int32_t winner = 0, runner_up = 0;
        for (int i = 0; i < kLanes; ++i)
            for (const int32_t packed : {best[row - begin][i], second[row - begin][i]}) {
                runner_up = std::max(runner_up, std::min(winner, packed));
                winner = std::max(winner, packed);
            }
        result.nearest[row] = std::min(index_of(winner), panels.count - 1);
        result.score[row] = score_of(winner);
        result.second_score[row] = score_of(runner_up);
    }
}

}  // namespace
}  // namespace core

using namespace core;

// For each of num1 descriptors the nearest of num2 (`nearest`), its score and that of the second nearest; for each of
// num2 the nearest of num1 (`back`). score = 16320 - |b|^2 / 2 + a . b, so that |a - b|^2 = |a|^2 + 2 * (16320 - score)
// but for rounding. At most 65535 descriptors, each of bytes below 128 and norm at most 181; returns 1, and computes
// nothing, where they are not.
CORE_API int32_t core_match(const uint8_t* first, int num1, const uint8_t* second, int num2, int32_t* nearest,
                            int32_t* score, int32_t* second_score, int32_t* back) {
    if (std::max(num1, num2) > 0xffff || !fit_sums(first, num1) || !fit_sums(second, num2)) return 1;
    const Panels panels(second, num2);
    std::vector<int32_t> half_norms(num1);
    for (int i = 0; i < num1; ++i) half_norms[i] = half_norm(first + size_t(i) * kSize);
    const Result result = {nearest, score, second_score, back};
    std::vector<std::vector<IntVec>> column_best(num_threads(), std::vector<IntVec>(panels.num_panels, IntVec{}));
    run_ranges(num1, kRowsPerTask, [&](int begin, int end, int thread) {
        match_rows(first, half_norms.data(), begin, end, panels, column_best[thread].data(), result);
    });
    for (int column = 0; column < num2; ++column) {
        int32_t winner = 0;
        for (const auto& mine : column_best) winner = std::max(winner, mine[column / kLanes][column % kLanes]);
        back[column] = index_of(winner);
    }
    return 0;
}
