// Checks of the compiled core that need no Python, so that they run under an emulator or a sanitizer.
//
//   check_core CASE      renders the case and compares with the images and gradients stored in it
//   check_core           without a case: odd sizes, no Gaussians, bad input, the loss, matches; prints nothing if well
//
// A case is written by tests/recon/core/test_native_core.py from the float64 reference.
#include <cmath>
#include <cstdio>
#include <cstring>
#include <string>
#include <utility>
#include <vector>

#include "rasterize.h"

using namespace core;
using Floats = std::vector<float>;

extern "C" {
int core_raster_forward(const RasterInput*, const RasterImages*, Raster**);
void core_raster_backward(const RasterInput*, Raster*, int, const RasterImages*, const RasterImages*, RasterGradients*);
void core_raster_release(Raster*);
void core_set_threads(int);
void core_photometric_moments(const float*, int, int, float*, float*);
double core_photometric(const float*, const float*, const float*, const float*, const float*, double, double, int, int,
                        float*);
int32_t core_match(const uint8_t*, int, const uint8_t*, int, int32_t*, int32_t*, int32_t*, int32_t*);
}

namespace {

int failures = 0;

void expect(bool condition, const std::string& what) {
    if (condition) return;
    std::printf("failed: %s\n", what.c_str());
    ++failures;
}

struct Scene {
    int count = 0, bases = 1, width = 0, height = 0, antialias = 0;
    Floats means, quats, scales, opacities, sh;
    double T_world_camera[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    double focal[2] = {}, principal[2] = {};

    RasterInput input() const {
        RasterInput in = {};
        in.num_gaussians = count, in.sh_bases = bases, in.width = width, in.height = height;
        in.antialias = antialias, in.channels = kRgb | kDepth | kNormal | kAlpha, in.near_plane = 0.01f;
        in.means = means.data(), in.quats = quats.data(), in.scales = scales.data();
        in.opacities = opacities.data(), in.sh = sh.data();
        std::memcpy(in.T_world_camera, T_world_camera, sizeof T_world_camera);
        std::memcpy(in.focal, focal, sizeof focal);
        std::memcpy(in.principal, principal, sizeof principal);
        return in;
    }
};

// rgb, depth, normal, alpha: planar, one after the other.
struct Images {
    Floats pixels;
    size_t plane;
    Images(int width, int height) : pixels(8 * size_t(width) * height), plane(size_t(width) * height) {}
    RasterImages views() {
        float* at = pixels.data();
        return {at, at + 3 * plane, at + 4 * plane, at + 7 * plane};
    }
};

struct Gradients {
    Floats means, quats, scales, opacities, sh;
    RasterGradients views;
    explicit Gradients(const Scene& scene)
        : means(scene.means.size()), quats(scene.quats.size()), scales(scene.scales.size()),
          opacities(scene.opacities.size()), sh(scene.sh.size()), views() {
        views.means = means.data(), views.quats = quats.data(), views.scales = scales.data();
        views.opacities = opacities.data(), views.sh = sh.data();
    }
};

int render(const Scene& scene, Images& images, Images& image_gradients, Gradients& gradients) {
    const RasterInput input = scene.input();
    const RasterImages to = images.views(), from = image_gradients.views();
    Raster* raster = nullptr;
    const int errors = core_raster_forward(&input, &to, &raster);
    if (errors) return errors;
    core_raster_backward(&input, raster, input.channels, &to, &from, &gradients.views);
    core_raster_release(raster);
    return 0;
}

// ---- A stored case -------------------------------------------------------------------------------------------------

template <class T>
void read(std::FILE* file, T* to, size_t count) {
    if (std::fread(to, sizeof(T), count, file) != count) {
        std::printf("failed: the case ends early\n");
        std::exit(2);
    }
}

Floats read_floats(std::FILE* file, size_t count) {
    Floats values(count);
    read(file, values.data(), count);
    return values;
}

template <class T>
void expect_close(const std::string& name, const T* actual, const Floats& expected, double tolerance) {
    double difference = 0, norm = 0;
    for (size_t i = 0; i < expected.size(); ++i) {
        difference += (actual[i] - expected[i]) * double(actual[i] - expected[i]);
        norm += double(expected[i]) * expected[i];
    }
    const double relative = std::sqrt(difference / norm);
    std::printf("%s %.1e\n", name.c_str(), relative);
    expect(relative < tolerance, name);
}

void check_case(const char* path) {
    std::FILE* file = std::fopen(path, "rb");
    if (!file) {
        std::printf("failed: cannot open %s\n", path);
        std::exit(2);
    }
    Scene scene;
    int32_t header[5];
    read(file, header, 5);
    scene.count = header[0], scene.bases = header[1], scene.width = header[2], scene.height = header[3];
    scene.antialias = header[4];
    const size_t n = scene.count, pixels = size_t(scene.width) * scene.height;
    read(file, scene.T_world_camera, 16);
    read(file, scene.focal, 2);
    read(file, scene.principal, 2);
    scene.means = read_floats(file, 3 * n), scene.quats = read_floats(file, 4 * n);
    scene.scales = read_floats(file, 3 * n), scene.opacities = read_floats(file, n);
    scene.sh = read_floats(file, 3 * n * scene.bases);

    Images images(scene.width, scene.height), image_gradients(scene.width, scene.height);
    Gradients gradients(scene);
    image_gradients.pixels = read_floats(file, 8 * pixels);
    expect(render(scene, images, image_gradients, gradients) == 0, "the case is accepted");
    expect_close("images", images.pixels.data(), read_floats(file, 8 * pixels), 2e-5);
    expect_close("means", gradients.means.data(), read_floats(file, 3 * n), 1e-4);
    expect_close("quats", gradients.quats.data(), read_floats(file, 4 * n), 1e-4);
    expect_close("scales", gradients.scales.data(), read_floats(file, 3 * n), 1e-4);
    expect_close("opacities", gradients.opacities.data(), read_floats(file, n), 1e-4);
    expect_close("sh", gradients.sh.data(), read_floats(file, 3 * n * scene.bases), 1e-4);
    expect_close("T_world_camera", gradients.views.T_world_camera, read_floats(file, 16), 1e-4);
    expect_close("focal", gradients.views.focal, read_floats(file, 2), 1e-4);
    expect_close("principal", gradients.views.principal, read_floats(file, 2), 1e-4);
    std::fclose(file);
}

// ---- Without a case ------------------------------------------------------------------------------------------------

// Numbers in [0, 1), the same everywhere.
float noise() {
    static uint32_t state = 1;
    state = state * 1664525u + 1013904223u;
    return float(state >> 8) / float(1 << 24);
}

Scene random_scene(int count, int bases, int width, int height) {
    Scene scene;
    scene.count = count, scene.bases = bases, scene.width = width, scene.height = height;
    for (int i = 0; i < count; ++i) {
        scene.means.insert(scene.means.end(), {3 * noise() - 1.5f, 3 * noise() - 1.5f, 5 * noise() - 0.5f});
        scene.quats.insert(scene.quats.end(), {noise() - 0.5f, noise() - 0.5f, noise() - 0.5f, 0.1f + noise()});
        scene.scales.insert(scene.scales.end(), {0.3f * noise(), 0.3f * noise(), 1e-4f * noise()});
        scene.opacities.push_back(noise());
        for (int k = 0; k < 3 * bases; ++k) scene.sh.push_back(noise() - 0.5f);
    }
    scene.focal[0] = scene.focal[1] = width;
    scene.principal[0] = 0.5 * width, scene.principal[1] = 0.5 * height;
    return scene;
}

void check_sizes() {
    const int sizes[][2] = {{1, 1}, {3, 2}, {33, 1}, {1, 65}, {70, 53}, {64, 64}};
    for (const auto& size : sizes)
        for (int count : {0, 1, 7, 300, 1000})
            for (int antialias : {0, 1}) {
                Scene scene = random_scene(count, count % 2 ? 1 : 16, size[0], size[1]);
                scene.antialias = antialias;
                Images images(size[0], size[1]), image_gradients(size[0], size[1]);
                for (float& value : image_gradients.pixels) value = noise() - 0.5f;
                Gradients gradients(scene);
                const std::string name = std::to_string(count) + " Gaussians at " + std::to_string(size[0]) + " x " +
                                         std::to_string(size[1]);
                expect(render(scene, images, image_gradients, gradients) == 0, name + " are accepted");
                bool finite = true;
                for (float value : images.pixels) finite = finite && std::isfinite(value);
                for (float value : gradients.scales) finite = finite && std::isfinite(value);
                expect(finite, name + " are finite");
            }
}

void check_bad_input() {
    Images images(20, 20), image_gradients(20, 20);
    const auto errors = [&](void (*spoil)(Scene&)) {
        Scene scene = random_scene(50, 4, 20, 20);
        spoil(scene);
        Gradients gradients(scene);
        return render(scene, images, image_gradients, gradients);
    };
    expect(errors([](Scene& s) { s.means[30] = NAN; }) == kBadMeans, "NaN in means is named");
    expect(errors([](Scene& s) { s.quats[4] = s.quats[5] = s.quats[6] = s.quats[7] = 0; }) == kBadQuats, "a zero quat");
    expect(errors([](Scene& s) { s.scales[149] = -1; }) == kBadScales, "a negative scale is named");
    expect(errors([](Scene& s) { s.opacities[49] = 2; }) == kBadOpacities, "an opacity of 2 is named");
    expect(errors([](Scene& s) { s.scales.assign(s.scales.size(), 1e18f); }) == 0, "huge Gaussians are left out");
}

void check_loss() {
    const int sizes[][2] = {{1, 1}, {17, 3}, {40, 120}};
    for (const auto& size : sizes) {
        const size_t count = 3 * size_t(size[0]) * size[1];
        Floats image(count), target(count), mean(count), variance(count), weights(count / 3), gradient(count);
        for (size_t i = 0; i < count; ++i) image[i] = noise(), target[i] = noise();
        for (float& weight : weights) weight = noise() < 0.3f ? 0.0f : noise();
        weights[0] = 1;
        core_photometric_moments(target.data(), size[0], size[1], mean.data(), variance.data());
        const double same = core_photometric(target.data(), target.data(), mean.data(), variance.data(), nullptr,
                                             count / 3.0, 0.2, size[0], size[1], gradient.data());
        expect(std::fabs(same) < 1e-5, "equal images have no loss");
        const double loss = core_photometric(image.data(), target.data(), mean.data(), variance.data(), weights.data(),
                                             count / 3.0, 0.2, size[0], size[1], gradient.data());
        expect(loss > 0.01, "different images have a loss");
    }
}

// Integers: what a plain loop finds is found exactly, whatever the instruction set.
void check_matches() {
    constexpr int kSize = 128;
    for (const auto& counts : {std::pair(1, 1), std::pair(61, 37), std::pair(100, 130)}) {
        std::vector<uint8_t> first(size_t(counts.first) * kSize), second(size_t(counts.second) * kSize);
        for (auto* set : {&first, &second})
            for (uint8_t& value : *set) value = uint8_t(noise() * 23);  // of norm 143 in the mean
        std::vector<int32_t> nearest(counts.first), score(counts.first), runner_up(counts.first), back(counts.second);
        core_match(first.data(), counts.first, second.data(), counts.second, nearest.data(), score.data(),
                   runner_up.data(), back.data());
        for (int i = 0; i < counts.first; ++i) {
            int best = 0, best_score = -1;
            for (int j = 0; j < counts.second; ++j) {
                int dot = 0, squared = 0;
                for (int k = 0; k < kSize; ++k) {
                    dot += first[size_t(i) * kSize + k] * second[size_t(j) * kSize + k];
                    squared += second[size_t(j) * kSize + k] * second[size_t(j) * kSize + k];
                }
                const int found = 16320 - squared / 2 + dot;
                if (found > best_score) best = j, best_score = found;
            }
            expect(nearest[i] == best && score[i] == best_score, "the nearest descriptor");
        }
    }
}

}  // namespace

int main(int argc, char** argv) {
    for (int threads : {1, 3}) {
        core_set_threads(threads);
        if (argc > 1) {
            check_case(argv[1]);
        } else {
            check_sizes();
            check_bad_input();
            check_loss();
            check_matches();
        }
    }
    return failures ? 1 : 0;
}
