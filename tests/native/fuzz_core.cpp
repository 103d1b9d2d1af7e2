// Random and hostile numbers for what of the core computes on shapes that Python has checked: bundle adjustment,
// PatchMatch stereo, the partition of an image, and matching. Built with sanitizers by tests/fuzz/sanitize.py.
//
// fuzz_core SECONDS SEED FIRST_ROUND: prints a line of JSON before each round, and one with the counts at the end.
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "bundle_cost.h"
#include "patchmatch.h"

namespace patchmatch {

// As in patchmatch_check.cpp and patchmatch_support.cpp.
struct Other {
    const Plane* planes;
    int32_t width, height;
    Transfer from_reference, to_reference;
};
struct Tolerance {
    float pixels, relative_depth;
};
struct Agreement {
    float* inverse_depth;
    uint8_t *num_consistent, *num_inside, *num_conflicting;
};
struct Surface {
    const uint8_t* grey;
    const Plane* planes;
    const uint8_t* num_consistent;
    int32_t width, height;
    float sigma_grey, sigma_space;
};

}  // namespace patchmatch

// As in partition.cpp.
struct Partition {
    const float *features, *weights;
    const uint8_t* wanted;
    int32_t width, height, tile, smallest;
    float most_error, noise;
};

extern "C" {
void core_set_threads(int);
double core_bundle_adjust(const core::Bundle*, int, double);
void core_bundle_information(const core::Bundle*, double*);
int32_t patchmatch_run(const patchmatch::Problem*);
void patchmatch_pack(const uint8_t*, int32_t, int32_t, int32_t*);
void patchmatch_check(const patchmatch::Plane*, int32_t, int32_t, const patchmatch::Other*, int32_t,
                      const patchmatch::Tolerance*, const patchmatch::Agreement*);
void patchmatch_support(const patchmatch::Surface*, float, float, patchmatch::Plane*, float*, float*);
int32_t core_partition(const Partition*, int32_t*);
int32_t core_match(const uint8_t*, int, const uint8_t*, int, int32_t*, int32_t*, int32_t*, int32_t*);
int32_t core_match_near(const uint8_t*, const float*, int, const uint8_t*, const float*, int, float, int32_t*, int32_t*,
                        int32_t*, int32_t*);
}

namespace {

class Draw {
public:
    explicit Draw(uint64_t seed) : engine_(seed) {
        hostile_ = whole(0, 2) * whole(0, 1) * 0.02 * (1 + whole(0, 9));  // two thirds of all rounds have none
    }

    int whole(int least, int most) { return std::uniform_int_distribution<int>(least, most)(engine_); }

    // Mostly of a normal distribution; in a hostile round, some of those numbers that break a computation.
    double number(double size = 1) {
        static const double kHostile[] = {0.0,    -0.0, 1e-320, 1e-38, -1e-38, 1e18,     -1e18,
                                          3e38, -3e38,  1e300, -1e300, 1e9,   -2147483649.0, 0.5};
        if (std::uniform_real_distribution<double>(0, 1)(engine_) < hostile_) {
            const int which = whole(0, 17);
            if (which == 14) return std::numeric_limits<double>::quiet_NaN();
            if (which == 15) return std::numeric_limits<double>::infinity();
            if (which >= 16) return -std::numeric_limits<double>::infinity();
            return kHostile[which];
        }
        return size * std::normal_distribution<double>()(engine_);
    }

    float real(double size = 1) {
        const double drawn = number(size);
        return std::abs(drawn) > 3.4e38 ? std::copysign(std::numeric_limits<float>::infinity(), float(drawn > 0) - 0.5f)
                                        : float(drawn);
    }

    std::vector<double> numbers(size_t count, double size = 1) {
        std::vector<double> found(count);
        for (double& each : found) each = number(size);
        return found;
    }

    std::vector<float> reals(size_t count, double size = 1) {
        std::vector<float> found(count);
        for (float& each : found) each = real(size);
        return found;
    }

    std::vector<uint8_t> bytes(size_t count, int most = 255) {
        std::vector<uint8_t> found(count);
        for (uint8_t& each : found) each = uint8_t(whole(0, most));
        return found;
    }

private:
    std::mt19937_64 engine_;
    double hostile_;
};

void expect(bool condition, const char* what) {
    if (condition) return;
    std::fprintf(stderr, "fuzz_core: %s\n", what);
    std::exit(1);
}

// A rig of some of a bundle's cameras, with hostile numbers as the rest has.
struct FuzzRig {
    int num_sets, num_mounts;
    std::vector<double> set_rotations, set_translations, mount_rotations, mount_translations, between;
    std::vector<double> given_rotations, given_centres, given;
    std::vector<int32_t> set_of, mount_of;

    FuzzRig(Draw& draw, int cameras)
        : num_sets(draw.whole(0, 3)), num_mounts(num_sets ? draw.whole(1, 3) : 0),
          set_rotations(turns(draw, num_sets)), set_translations(draw.numbers(3 * size_t(num_sets))),
          mount_rotations(turns(draw, num_mounts)), mount_translations(draw.numbers(3 * size_t(num_mounts))),
          between(2 * size_t(cameras)), given_rotations(turns(draw, num_mounts)),
          given_centres(draw.numbers(3 * size_t(num_mounts))), given(2 * size_t(num_mounts)),
          set_of(cameras, -1), mount_of(cameras, -1) {
        for (double& weight : between) weight = draw.whole(0, 2) * 50.0;
        for (size_t mount = 0; mount < given.size(); mount += 2)  // below 0: fixed
            given[mount] = given[mount + 1] = mount ? draw.whole(-1, 2) * 10.0 : -1.0;
        for (int camera = 0; num_sets && camera < cameras; ++camera) {
            if (!draw.whole(0, 2)) continue;
            set_of[camera] = draw.whole(0, num_sets - 1);
            mount_of[camera] = draw.whole(0, num_mounts - 1);
        }
    }

    static std::vector<double> turns(Draw& draw, int count) {
        auto found = draw.numbers(9 * size_t(count), 0.1);
        for (size_t i = 0; i < found.size(); i += 9)
            for (size_t k = 0; k < 9; k += 4) found[i + k] += 1;
        return found;
    }
};

void bundle(Draw& draw) {
    const int cameras = draw.whole(1, 5), lenses = draw.whole(1, cameras), points = draw.whole(0, 30);
    std::vector<int32_t> lens_of(cameras), camera_of, first_of = {0};
    for (int32_t& lens : lens_of) lens = draw.whole(0, lenses - 1);
    for (int point = 0; point < points; ++point) {
        for (int seen = draw.whole(0, 6); seen > 0; --seen) camera_of.push_back(draw.whole(0, cameras - 1));
        first_of.push_back(int32_t(camera_of.size()));
    }
    auto rotations = draw.numbers(9 * size_t(cameras), 0.1), translations = draw.numbers(3 * size_t(cameras));
    for (int camera = 0; camera < cameras; ++camera)
        for (int i = 0; i < 3; ++i) rotations[9 * size_t(camera) + 4 * i] += 1;
    auto focals = draw.numbers(lenses, 2), radials = draw.numbers(2 * size_t(lenses), 0.1);
    auto shifts = draw.numbers(2 * size_t(lenses)), aspects = draw.numbers(lenses, 0.1);
    auto skews = draw.numbers(lenses, 0.1);
    auto places = draw.numbers(3 * size_t(points), 3), means = draw.numbers(7 * size_t(lenses));
    const auto pixels = draw.numbers(2 * camera_of.size(), 300);
    std::vector<double> information(49 * size_t(lenses) * lenses);
    for (int k = 0; k < 7 * lenses; ++k) information[size_t(k) * 7 * lenses + k] = draw.whole(0, 2) * 10.0;
    auto given_rotations = rotations, given_centres = draw.numbers(3 * size_t(cameras));
    // Positive semi-definite, as an inverse covariance is: weights of the single poses, and what poses share.
    const size_t numbers = 6 * size_t(cameras);
    std::vector<double> given(numbers * numbers), shared(numbers);
    for (int camera = 0; camera < cameras; ++camera) {
        const double weight = draw.whole(0, 2) * 10.0, common = draw.whole(0, 1) * 3.0;
        for (size_t i = 6 * size_t(camera); i < 6 * size_t(camera + 1); ++i)
            given[i * numbers + i] = weight, shared[i] = weight > 0 ? common : 0;
    }
    for (size_t i = 0; i < numbers; ++i)
        for (size_t j = 0; j < numbers; ++j) given[i * numbers + j] += shared[i] * shared[j];
    FuzzRig rig(draw, cameras);
    const core::Bundle task = {rotations.data(),  translations.data(), focals.data(),    radials.data(),
                               shifts.data(),     aspects.data(),      skews.data(),     places.data(),    lens_of.data(),
                               camera_of.data(),  first_of.data(),     pixels.data(),    means.data(),
                               information.data(), cameras,            lenses,           points,
                               draw.whole(-1, cameras - 1), draw.whole(1, 9) * 1.0,
                               given_rotations.data(), given_centres.data(), given.data(),
                               rig.set_rotations.data(), rig.set_translations.data(), rig.mount_rotations.data(),
                               rig.mount_translations.data(), rig.set_of.data(), rig.mount_of.data(),
                               rig.between.data(), rig.given_rotations.data(), rig.given_centres.data(),
                               rig.given.data(), rig.num_sets, rig.num_mounts};
    core_bundle_adjust(&task, draw.whole(0, 8), 1e-6);
    const size_t size = 6 * size_t(cameras + rig.num_sets + rig.num_mounts) + 7 * size_t(lenses);
    std::vector<double> matrix(size * size);
    core_bundle_information(&task, matrix.data());
}

patchmatch::Transfer transfer(Draw& draw) {
    patchmatch::Transfer found;
    for (int k = 0; k < 9; ++k) found.A[k] = draw.real(0.05) + (k % 4 == 0);
    for (float& each : found.t) each = draw.real();
    return found;
}

std::vector<patchmatch::Plane> planes(Draw& draw, size_t count) {
    std::vector<patchmatch::Plane> found(count);
    for (auto& plane : found) plane = {draw.real() + 1, draw.real(0.1), draw.real(0.1)};
    return found;
}

void stereo(Draw& draw) {
    const int width = draw.whole(1, 24), height = draw.whole(1, 18), count = draw.whole(1, 4);
    const size_t size = size_t(width) * height;
    const auto grey = draw.bytes(size);
    auto found = planes(draw, size);
    std::vector<float> costs(size);
    std::vector<std::vector<int32_t>> packed(count);
    std::vector<std::vector<float>> depths(count);
    std::vector<std::vector<patchmatch::Plane>> theirs(count);
    std::vector<patchmatch::Source> sources;
    std::vector<patchmatch::Other> others;
    for (int s = 0; s < count; ++s) {
        const int across = draw.whole(1, 24), down = draw.whole(1, 18);
        const size_t pixels = size_t(across) * down;
        packed[s].resize(pixels);
        patchmatch_pack(draw.bytes(pixels).data(), across, down, packed[s].data());
        depths[s] = draw.reals(pixels);
        theirs[s] = planes(draw, pixels);
        const auto there = transfer(draw), back = transfer(draw);
        sources.push_back({packed[s].data(), depths[s].data(), across, down, there, back});
        others.push_back({theirs[s].data(), across, down, there, back});
    }
    const float nearest = 0.5f + std::abs(draw.real());
    const patchmatch::Problem problem = {
        grey.data(), found.data(), costs.data(), width, height, 20 + draw.real(), 20 + draw.real(), draw.real(9),
        draw.real(9), 0.1f, nearest, sources.data(), count, draw.whole(1, 5), draw.whole(0, 3), draw.whole(0, 2),
        uint32_t(draw.whole(0, 9)), uint32_t(draw.whole(0, 9)), draw.real(), 0.5f, 10.0f, 3.0f,
        draw.whole(0, 1) * 4.0f, draw.real(0.1), 3.0f, draw.whole(0, 1) * 0.2f, 3.0f};
    expect(patchmatch_run(&problem) == 0, "PatchMatch refuses what it should take");
    std::vector<float> depth(size), supports(size), contrasts(size);
    std::vector<uint8_t> consistent(size), inside(size), conflicting(size);
    const patchmatch::Tolerance tolerance = {1.0f, 0.01f};
    const patchmatch::Agreement agreement = {depth.data(), consistent.data(), inside.data(), conflicting.data()};
    patchmatch_check(found.data(), width, height, others.data(), count, &tolerance, &agreement);
    const patchmatch::Surface surface = {grey.data(), found.data(), consistent.data(), width, height, 10.0f, 3.0f};
    std::vector<patchmatch::Plane> supported(size);
    patchmatch_support(&surface, 0.4f, 0.6f, supported.data(), supports.data(), contrasts.data());
}

void partition(Draw& draw) {
    const int width = draw.whole(1, 70), height = draw.whole(1, 50), tile = draw.whole(1, 33);
    const size_t size = size_t(width) * height;
    const auto features = draw.reals(4 * size), weights = draw.reals(size);
    const auto wanted = draw.bytes(size, draw.whole(0, 3));
    const Partition task = {features.data(), weights.data(), wanted.data(), width, height, tile, draw.whole(0, 20),
                            draw.real(), draw.real(0.1)};
    std::vector<int32_t> labels(size);
    const int count = core_partition(&task, labels.data());
    expect(count >= 0 && count <= int(size), "more pieces than pixels");
    for (size_t i = 0; i < size; ++i)
        expect(wanted[i] ? labels[i] >= 0 && labels[i] < count : labels[i] == -1, "a label of no piece");
}

void matches(Draw& draw) {
    const int num1 = draw.whole(1, 90), num2 = draw.whole(1, 90), most = draw.whole(0, 3) ? 26 : 255;
    const auto first = draw.bytes(size_t(num1) * 128, most), second = draw.bytes(size_t(num2) * 128, most);
    std::vector<float> at1 = draw.reals(2 * size_t(num1), 100), at2 = draw.reals(2 * size_t(num2), 100);
    for (auto* places : {&at1, &at2})
        for (float& each : *places) each = std::isfinite(each) ? each : 0;  // as Python has checked
    std::vector<int32_t> nearest(num1), score(num1), next(num1), back(num2);
    const auto check = [&](int32_t problem, int least) {
        for (int32_t found : nearest) expect(problem || (found >= least && found < num2), "a nearest that is none");
        for (int32_t found : back) expect(problem || (found >= least && found < num1), "a way back to none");
    };
    check(core_match(first.data(), num1, second.data(), num2, nearest.data(), score.data(), next.data(), back.data()), 0);
    const float reach = 1e-3f + std::abs(at1[0]);
    check(core_match_near(first.data(), at1.data(), num1, second.data(), at2.data(), num2, reach, nearest.data(),
                          score.data(), next.data(), back.data()), -1);
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 4) return 2;
    const double seconds = std::atof(argv[1]);
    const uint64_t seed = std::strtoull(argv[2], nullptr, 10);
    const auto begin = std::chrono::steady_clock::now();
    const auto spent = [&] { return std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count(); };
    const std::pair<const char*, void (*)(Draw&)> kinds[] = {
        {"bundle", bundle}, {"patchmatch", stereo}, {"partition", partition}, {"match", matches}};
    std::map<std::string, long> counts;
    core_set_threads(2);
    long round = std::atol(argv[3]);
    for (; spent() < seconds; ++round) {
        const auto& [name, fuzz] = kinds[round % 4];
        std::printf("{\"round\": %ld, \"kind\": \"%s\"}\n", round, name);
        std::fflush(stdout);
        Draw draw(seed * 1000003 + uint64_t(round));
        fuzz(draw);
        ++counts[name];
    }
    std::printf("{\"rounds\": %ld", round);
    for (const auto& [name, count] : counts) std::printf(", \"%s\": %ld", name.c_str(), count);
    std::printf("}\n");
    return 0;
}
