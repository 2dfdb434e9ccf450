// What the example hosts share: owning pointers, errors, files.
#pragma once
#include <splatvk.h>

#include <cstdio>
#include <fstream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

struct EndContext {
    void operator()(SvkContext *context) const { svk_context_destroy(context); }
};
struct EndScene {
    void operator()(SvkScene *scene) const { svk_scene_destroy(scene); }
};
using Context = std::unique_ptr<SvkContext, EndContext>;
using Scene = std::unique_ptr<SvkScene, EndScene>;

// A structure of the interface, all zero but for its size.
template <typename T> T make() {
    T value{};
    value.size = sizeof value;
    return value;
}

// The text behind a failed call: `copy` is svk_context_error or svk_scene_error.
template <typename Handle> std::string last_error(size_t (*copy)(const Handle *, char *, size_t), const Handle *handle) {
    std::vector<char> text(copy(handle, nullptr, 0) + 1);
    copy(handle, text.data(), text.size());
    return text.data();
}

inline void check(SvkStatus status, const SvkContext *context) {
    if (status != SVK_STATUS_OK) throw std::runtime_error(last_error(svk_context_error, context));
}
inline void check(SvkStatus status, const SvkScene *scene) {
    if (status != SVK_STATUS_OK) throw std::runtime_error(last_error(svk_scene_error, scene));
}

inline std::vector<unsigned char> read_file(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(path + ": cannot be read");
    return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

// Photos as files in memory, which must outlive them.
inline std::vector<SvkPhoto> encoded_photos(const std::vector<std::vector<unsigned char>> &files) {
    std::vector<SvkPhoto> photos;
    for (const auto &file : files) {
        auto photo = make<SvkPhoto>();
        photo.encoded = file.data();
        photo.encoded_bytes = file.size();
        photos.push_back(photo);
    }
    return photos;
}

// Writes RGBA bytes as a binary PPM, which any image program opens; alpha is left out.
inline void write_ppm(const std::string &path, unsigned width, unsigned height, const unsigned char *rgba) {
    std::ofstream file(path, std::ios::binary);
    file << "P6\n" << width << " " << height << "\n255\n";
    for (size_t i = 0; i < size_t(width) * height; i++) file.write(reinterpret_cast<const char *>(rgba + 4 * i), 3);
    if (!file) throw std::runtime_error(path + ": cannot be written");
}

inline SvkCamera scene_camera(SvkScene *scene, unsigned index) {
    auto camera = make<SvkCamera>();
    check(svk_scene_camera(scene, index, &camera, nullptr, 0), scene);
    return camera;
}
