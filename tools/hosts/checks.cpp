// What the interface must refuse, and how it says so; linked with the static library.
//   checks SCENE PHOTO PHOTO...
#include "host.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <thread>

static int failures = 0;
#define EXPECT(condition)                                                                                              \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            std::fprintf(stderr, "checks.cpp:%d: not so: %s\n", __LINE__, #condition);                                 \
            failures++;                                                                                                \
        }                                                                                                              \
    } while (0)

static bool says(const std::string &text, const char *word) { return text.find(word) != std::string::npos; }

static int32_t stop(void *calls, const SvkProgress *) { return ++*static_cast<std::atomic<int> *>(calls) >= 3; }

static void contexts() {
    SvkContext *context = reinterpret_cast<SvkContext *>(1);
    auto options = make<SvkContextOptions>();
    options.device = "no such device";
    EXPECT(svk_context_create(&options, &context) == SVK_STATUS_INPUT && !context);
    EXPECT(says(last_error(svk_context_error, static_cast<SvkContext *>(nullptr)), "no such device"));
    EXPECT(svk_context_create(nullptr, nullptr) == SVK_STATUS_ARGUMENT);
    options.size = 1;
    EXPECT(svk_context_create(&options, &context) == SVK_STATUS_ARGUMENT);
    EXPECT(says(last_error(svk_context_error, static_cast<SvkContext *>(nullptr)), "sizeof"));
    auto device = make<SvkVulkanDevice>();
    EXPECT(svk_context_adopt(&device, nullptr, &context) == SVK_STATUS_INPUT && !context);
    svk_context_destroy(nullptr);
    svk_scene_destroy(nullptr);
}

static void training(SvkContext *context, int count, char **paths) {
    std::vector<SvkPhoto> photos;
    for (int i = 0; i < count; i++) {
        photos.push_back(make<SvkPhoto>());
        photos.back().path = paths[i];
    }
    // Stopped by the callback: nothing is left, and the context goes on working.
    std::atomic<int> calls{0};
    auto options = make<SvkTrainOptions>();
    options.progress = stop;
    options.user = &calls;
    SvkScene *scene = nullptr;
    EXPECT(svk_train(context, photos.data(), photos.size(), &options, &scene) == SVK_STATUS_CANCELLED && !scene);
    EXPECT(calls >= 3);
    EXPECT(svk_train(context, photos.data(), 1, nullptr, &scene) == SVK_STATUS_INPUT);
    EXPECT(svk_train(context, nullptr, 2, nullptr, &scene) == SVK_STATUS_ARGUMENT);
    EXPECT(svk_train(nullptr, photos.data(), 2, nullptr, &scene) == SVK_STATUS_ARGUMENT);
    options.preset = 77;
    EXPECT(svk_train(context, photos.data(), photos.size(), &options, &scene) == SVK_STATUS_ARGUMENT);
    EXPECT(says(last_error(svk_context_error, context), "preset"));
    options.preset = SVK_PRESET_AUTO;
    options.sh_degree = 5;
    EXPECT(svk_train(context, photos.data(), photos.size(), &options, &scene) == SVK_STATUS_ARGUMENT);
    EXPECT(says(last_error(svk_context_error, context), "sh_degree"));
    options.sh_degree = SVK_SH_DEGREE_AUTO;
    options.depth_prior = "no such network";
    EXPECT(svk_train(context, photos.data(), photos.size(), &options, &scene) == SVK_STATUS_INPUT);
    EXPECT(says(last_error(svk_context_error, context), "depth-prior"));
    photos[0].encoded = reinterpret_cast<const uint8_t *>("both");
    EXPECT(svk_train(context, photos.data(), photos.size(), nullptr, &scene) == SVK_STATUS_ARGUMENT);
    photos[0].path = nullptr;
    photos[0].encoded_bytes = 4;
    EXPECT(svk_train(context, photos.data(), photos.size(), nullptr, &scene) == SVK_STATUS_INPUT);
    EXPECT(says(last_error(svk_context_error, context), "photo_00"));
}

static std::vector<float> render(SvkScene *scene, const SvkCamera &camera, uint32_t channel, size_t values,
                                 const char *text = nullptr) {
    std::vector<float> out(size_t(camera.width) * camera.height * values);
    auto output = make<SvkOutput>();
    output.channel = channel;
    output.encoding = SVK_ENCODING_F32;
    output.text = text;
    output.host = out.data();
    output.bytes = 4 * out.size();
    check(svk_scene_render(scene, &camera, &output, 1, nullptr), scene);
    output.bytes--;
    EXPECT(svk_scene_render(scene, &camera, &output, 1, nullptr) == SVK_STATUS_ARGUMENT);
    return out;
}

// Presence, things in space, and what is not understood of a text.
static void evidence(SvkScene *scene, const SvkCamera &camera) {
    std::vector<uint8_t> mask(size_t(camera.width) * camera.height);
    for (const char *text : {"lemon", "piano", "elephant", "iguana", "mug without handle"}) {
        auto answer = make<SvkAnswer>();
        check(svk_scene_query(scene, text, &camera, &answer, mask.data(), mask.size()), scene);
        EXPECT(answer.presence >= SVK_PRESENCE_FOUND && answer.presence <= SVK_PRESENCE_ABSENT);
        EXPECT(answer.p_value > 0 && answer.p_value <= 1);
        EXPECT(answer.presence != SVK_PRESENCE_ABSENT || (!answer.found && !answer.instances));
        const bool empty = std::all_of(mask.begin(), mask.end(), [](uint8_t m) { return m == 0; });
        EXPECT(empty == !answer.found && empty == !answer.mask_pixels);
        size_t count = 0;
        check(svk_scene_instances(scene, text, &camera, nullptr, 0, &count), scene);
        EXPECT(count == answer.instances);
        std::vector<SvkInstance> things(count + 1, make<SvkInstance>());
        check(svk_scene_instances(scene, text, &camera, things.data(), things.size(), &count), scene);
        for (size_t i = 0; i < count; i++) {
            EXPECT(things[i].splats > 0 && things[i].box_size[0] >= things[i].box_size[2]);
            for (int k = 0; k < 3; k++) EXPECT(things[i].box_min[k] <= things[i].box_max[k]);
        }
        EXPECT(things[count].splats == 0);
        EXPECT(svk_scene_instances(scene, text, &camera, things.data(), things.size(), nullptr) == SVK_STATUS_ARGUMENT);
        char notes[256];
        check(svk_scene_notes(scene, text, notes, sizeof notes), scene);
        const bool cut = says(text, "without");
        EXPECT(says(notes, "without handle") == cut && (!cut || answer.presence != SVK_PRESENCE_FOUND));
        // A host of the first version knows only the fields up to the mask's pixels.
        auto old = make<SvkAnswer>();
        old.size = offsetof(SvkAnswer, presence);
        old.presence = 77;
        check(svk_scene_query(scene, text, &camera, &old, nullptr, 0), scene);
        EXPECT(old.presence == 77 && old.score == answer.score);
    }
    EXPECT(svk_scene_notes(scene, nullptr, nullptr, 0) == SVK_STATUS_ARGUMENT);
}

static void reading(SvkContext *context, const char *path) {
    SvkScene *loaded = nullptr;
    EXPECT(svk_scene_load(context, "no/such/scene", &loaded) == SVK_STATUS_INPUT && !loaded);
    check(svk_scene_load(context, path, &loaded), context);
    Scene scene(loaded);
    auto info = make<SvkSceneInfo>();
    check(svk_scene_info(loaded, &info), loaded);
    EXPECT(info.splats > 1000 && info.cameras >= 2 && info.codes[0] + info.codes[1] + info.codes[2] > 0);
    std::vector<float> means(3 * info.splats);
    check(svk_scene_read(loaded, SVK_ARRAY_MEANS, means.data(), means.size()), loaded);
    EXPECT(svk_scene_read(loaded, SVK_ARRAY_MEANS, means.data(), means.size() - 1) == SVK_STATUS_ARGUMENT);
    std::vector<float> seen(means.size() / 3);
    check(svk_scene_read(loaded, SVK_ARRAY_SEEN, seen.data(), seen.size()), loaded);
    EXPECT(*std::max_element(seen.begin(), seen.end()) > 0.05f);
    SvkCamera camera = scene_camera(loaded, 0);
    auto none = make<SvkCamera>();
    EXPECT(svk_scene_camera(loaded, 99, &none, nullptr, 0) == SVK_STATUS_ARGUMENT);
    char name[8];
    check(svk_scene_camera(loaded, 0, &none, name, sizeof name), loaded);
    EXPECT(std::strlen(name) == 7 && none.fx == camera.fx);

    const auto alpha = render(loaded, camera, SVK_CHANNEL_ALPHA, 1), depth = render(loaded, camera, SVK_CHANNEL_DEPTH, 1);
    const auto colour = render(loaded, camera, SVK_CHANNEL_COLOUR, 4);
    bool same = true, positive = true;
    for (size_t i = 0; i < alpha.size(); i++) {
        same &= colour[4 * i + 3] == alpha[i];
        positive &= (depth[i] > 0) == (alpha[i] >= 0.5f);
    }
    EXPECT(same && positive);
    for (uint32_t level = 0; level < 3; level++) {
        if (!info.codes[level]) continue;
        std::vector<float> features(alpha.size() * info.feature_dim[level]);
        auto output = make<SvkOutput>();
        output.channel = SVK_CHANNEL_FEATURES;
        output.level = level;
        output.host = features.data();
        output.bytes = 4 * features.size();
        check(svk_scene_render(loaded, &camera, &output, 1, nullptr), loaded);
        float most = 0;
        for (float f : features) most = std::fmax(most, std::fabs(f));
        EXPECT(most > 0.1f && most < 1.01f);
    }
    // Two threads on one scene: calls follow each other, and both answers are the same.
    SvkAnswer answers[2] = {make<SvkAnswer>(), make<SvkAnswer>()};
    SvkStatus statuses[2];
    auto ask = [&](int i) { statuses[i] = svk_scene_query(loaded, "lemon", &camera, &answers[i], nullptr, 0); };
    std::thread other(ask, 1);
    ask(0);
    other.join();
    EXPECT(statuses[0] == SVK_STATUS_OK && statuses[1] == SVK_STATUS_OK && answers[0].score == answers[1].score);
    const auto relevancy = render(loaded, camera, SVK_CHANNEL_RELEVANCY, 1, "lemon");
    float best = 0;
    for (float r : relevancy) best = std::fmax(best, r);
    EXPECT(best > 0 && best <= answers[0].score + 1e-6);
    EXPECT(svk_scene_query(loaded, " ", &camera, &answers[0], nullptr, 0) == SVK_STATUS_INPUT);
    evidence(loaded, camera);

    camera.world_to_camera[0][0] = NAN;
    EXPECT(svk_scene_query(loaded, "lemon", &camera, &answers[0], nullptr, 0) == SVK_STATUS_INPUT);
    camera = scene_camera(loaded, 0);
    auto buffer = make<SvkOutput>();
    buffer.buffer = 1;
    buffer.bytes = ~size_t(0);
    EXPECT(svk_scene_render(loaded, &camera, &buffer, 1, nullptr) == SVK_STATUS_INPUT);
    EXPECT(says(last_error(svk_scene_error, loaded), "own Vulkan device"));
    EXPECT(svk_scene_save(loaded, path, 0) == SVK_STATUS_INPUT);
    EXPECT(svk_scene_save(loaded, "no-such-format.foo", 0) == SVK_STATUS_INPUT);
    EXPECT(says(last_error(svk_scene_error, loaded), "no format of splats"));
}

// Pixels in memory with known cameras: what the scene shows at its own cameras makes a scene again, in the same axes.
static void pixels(SvkContext *context, const char *path) {
    SvkScene *loaded = nullptr;
    check(svk_scene_load(context, path, &loaded), context);
    Scene scene(loaded);
    SvkCamera cameras[2] = {scene_camera(loaded, 0), scene_camera(loaded, 1)};
    std::vector<SvkPhoto> photos;
    std::vector<std::vector<unsigned char>> images;
    // The second has three bytes a pixel and rows with a gap.
    const size_t bytes[2] = {4, 3}, gap[2] = {0, 5};
    for (int i = 0; i < 2; i++) {
        const SvkCamera &camera = cameras[i];
        std::vector<unsigned char> rgba(size_t(4) * camera.width * camera.height);
        auto output = make<SvkOutput>();
        output.encoding = SVK_ENCODING_UNORM8_X4;
        output.host = rgba.data();
        output.bytes = rgba.size();
        check(svk_scene_render(loaded, &camera, &output, 1, nullptr), loaded);
        const size_t row = bytes[i] * camera.width + gap[i];
        images.emplace_back(row * camera.height);
        for (size_t y = 0; y < camera.height; y++)
            for (size_t x = 0; x < camera.width; x++)
                std::memcpy(&images[i][y * row + bytes[i] * x], &rgba[4 * (y * camera.width + x)], bytes[i]);
        auto photo = make<SvkPhoto>();
        photo.pixels = images[i].data();
        photo.pixel_bytes = static_cast<uint32_t>(bytes[i]);
        photo.width = camera.width;
        photo.height = camera.height;
        photo.row_bytes = gap[i] ? row : 0;
        photo.camera = &cameras[i];
        photos.push_back(photo);
    }
    auto options = make<SvkTrainOptions>();
    options.preset = SVK_PRESET_DRAFT;
    options.iterations = 10;
    options.language_iterations = 1;
    options.sh_degree = SVK_SH_DEGREE_ONE;
    SvkScene *trained = nullptr;
    check(svk_train(context, photos.data(), 2, &options, &trained), context);
    Scene again(trained);
    auto info = make<SvkSceneInfo>();
    EXPECT(svk_scene_info(trained, &info) == SVK_STATUS_OK && info.sh_degree == 1);
    const SvkCamera first = scene_camera(trained, 0);
    double worst = std::fabs(first.fx - cameras[0].fx) / cameras[0].fx;
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 4; c++)
            worst = std::fmax(worst, std::fabs(first.world_to_camera[r][c] - cameras[0].world_to_camera[r][c]));
    EXPECT(worst < 1e-6);
    // The scene is where the cameras say: after a few steps the new one already looks far more like the old one from this
    // camera than the old one from the other camera does.
    const auto was = render(loaded, cameras[0], SVK_CHANNEL_COLOUR, 4), other = render(loaded, cameras[1], SVK_CHANNEL_COLOUR, 4);
    const auto is = render(trained, cameras[0], SVK_CHANNEL_COLOUR, 4);
    double change = 0, motion = 0;
    for (size_t i = 0; i < was.size(); i++) {
        change += std::fabs(was[i] - is[i]) / static_cast<double>(was.size());
        motion += std::fabs(was[i] - other[i]) / static_cast<double>(was.size());
    }
    std::printf("from its own renderings: mean difference %.4f, between the two cameras %.4f\n", change, motion);
    EXPECT(change < motion / 2);
    // A camera for one photo only cannot be meant.
    photos[1].camera = nullptr;
    EXPECT(svk_train(context, photos.data(), 2, &options, &trained) == SVK_STATUS_ARGUMENT);
}

int main(int argc, char **argv) {
    if (argc < 4) {
        std::fprintf(stderr, "usage: checks SCENE PHOTO PHOTO...\n");
        return 2;
    }
    try {
        EXPECT(svk_abi_version() == SVK_ABI_VERSION);
        contexts();
        SvkContext *made = nullptr;
        check(svk_context_create(nullptr, &made), made);
        Context context(made);
        training(made, argc - 2, argv + 2);
        reading(made, argv[1]);
        pixels(made, argv[1]);
    } catch (const std::exception &e) {
        std::fprintf(stderr, "checks: %s\n", e.what());
        return 1;
    }
    std::printf("%s\n", failures ? "failed" : "the interface refuses what it must");
    return failures ? 1 : 0;
}
