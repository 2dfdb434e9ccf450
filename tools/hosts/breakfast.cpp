// Photos in memory → scene → query → image: the whole of splatvk from a C++ program.
//   breakfast OUT STEPS SIDE PHOTO...  OUT/scene, OUT/lemon.ppm; STEPS of training, photos of at most SIDE pixels (0: as the preset says)
#include "host.hpp"

// Called for every step; anything but 0 would stop the training.
static int32_t progress(void *, const SvkProgress *p) {
    if (p->kind == SVK_PROGRESS_KIND_BEGIN) std::printf("%s\n", p->stage);
    if (p->kind == SVK_PROGRESS_KIND_WARNING) std::printf("warning: %s\n", p->note);
    return 0;
}

static int run(int argc, char **argv) {
    if (argc < 6) {
        std::fprintf(stderr, "usage: breakfast OUT STEPS SIDE PHOTO PHOTO...\n");
        return 2;
    }
    const std::string out = argv[1];
    SvkContext *made = nullptr;
    check(svk_context_create(nullptr, &made), made);
    Context context(made);
    char device[256];
    svk_context_device_name(context.get(), device, sizeof device);
    std::printf("splatvk %s on %s\n", svk_version(), device);

    // The photos could as well come from a camera or a socket: they are bytes in memory.
    std::vector<std::vector<unsigned char>> files;
    for (int i = 4; i < argc; i++) files.push_back(read_file(argv[i]));
    const std::vector<SvkPhoto> photos = encoded_photos(files);
    auto options = make<SvkTrainOptions>();
    options.preset = SVK_PRESET_DRAFT;
    options.iterations = options.language_iterations = std::stoul(argv[2]);
    options.max_size = std::stoul(argv[3]);
    options.progress = progress;
    SvkScene *trained = nullptr;
    check(svk_train(context.get(), photos.data(), photos.size(), &options, &trained), context.get());
    Scene scene(trained);

    auto info = make<SvkSceneInfo>();
    check(svk_scene_info(scene.get(), &info), scene.get());
    std::printf("%llu splats, %u cameras, codes %u %u %u\n", static_cast<unsigned long long>(info.splats), info.cameras,
                info.codes[0], info.codes[1], info.codes[2]);

    const SvkCamera camera = scene_camera(scene.get(), 0);
    const size_t pixels = size_t(camera.width) * camera.height;
    std::vector<unsigned char> image(4 * pixels), mask(pixels);
    auto colour = make<SvkOutput>();
    colour.channel = SVK_CHANNEL_COLOUR;
    colour.encoding = SVK_ENCODING_UNORM8_X4;
    colour.host = image.data();
    colour.bytes = image.size();
    check(svk_scene_render(scene.get(), &camera, &colour, 1, nullptr), scene.get());

    auto answer = make<SvkAnswer>();
    check(svk_scene_query(scene.get(), "lemon", &camera, &answer, mask.data(), mask.size()), scene.get());
    std::printf("lemon: %s, score %.2f at (%.1f, %.1f), %llu pixels\n", answer.found ? "found" : "not found", answer.score,
                answer.x, answer.y, static_cast<unsigned long long>(answer.mask_pixels));
    const char *presences[] = {"the text model cannot tell", "found", "unsure", "no sign of it"};
    std::printf("in the scene: %s (p = %.3f), %u of it\n", presences[answer.presence], answer.p_value, answer.instances);
    std::vector<SvkInstance> things(answer.instances, make<SvkInstance>());
    size_t count = 0;
    check(svk_scene_instances(scene.get(), "lemon", &camera, things.data(), things.size(), &count), scene.get());
    for (const auto &thing : things)
        std::printf("  at %.2f %.2f %.2f, %.2f long, %llu splats\n", thing.centre[0], thing.centre[1], thing.centre[2],
                    thing.box_size[0], static_cast<unsigned long long>(thing.splats));
    // What was not asked for gets darker.
    for (size_t i = 0; i < pixels; i++)
        for (size_t k = 0; k < 3; k++)
            if (!mask[i]) image[4 * i + k] /= 3;
    write_ppm(out + "/lemon.ppm", camera.width, camera.height, image.data());
    check(svk_scene_save(scene.get(), (out + "/scene").c_str(), 1), scene.get());
    std::printf("%s/lemon.ppm and %s/scene are written\n", out.c_str(), out.c_str());
    return 0;
}

int main(int argc, char **argv) {
    try {
        return run(argc, argv);
    } catch (const std::exception &e) {
        std::fprintf(stderr, "breakfast: %s\n", e.what());
        return 1;
    }
}
