// Makes and ends contexts, trains, renders, asks and saves from two threads, with random cancels, and watches what the process holds.
//   soak MINUTES OUT CAMERAS PHOTO PHOTO...
// Every second context is on a device of the host, whose Vulkan functions count the objects that are alive: none may be left when
// the context has ended. Memory, by malloc and by what is resident, and open files must not grow. Exit code 1 if anything does.
#include "host.hpp"
#include <vulkan/vulkan.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <dirent.h>
#include <map>
#include <mutex>
#include <random>
#include <thread>
#include <unistd.h>
#ifdef __GLIBC__
#include <malloc.h>
#endif

static const int ROUNDS = 6;
// From a third of the rounds to the last, per context: 3 to 12 KiB stay (docs/internals/trust.md#soak), a kept image or scene would be 75 KiB or more.
static const double KIB_PER_CONTEXT = 32;
// What is resident may be so much more then: it moves by a MiB where nothing is kept.
static const double ROOM_MIB = 8;

static std::atomic<bool> failed{false};
static void wrong(const std::string &what) {
    std::fprintf(stderr, "soak: %s\n", what.c_str());
    failed = true;
}

// ---- Vulkan objects that are alive, per device

static std::mutex live_lock;
static std::map<VkDevice, std::map<std::string, long>> live;
static void count(VkDevice device, const char *kind, long by) {
    std::lock_guard<std::mutex> guard(live_lock);
    live[device][kind] += by;
}

using Create = VkResult(VKAPI_PTR *)(VkDevice, const void *, const void *, void *);
using Destroy = void(VKAPI_PTR *)(VkDevice, uint64_t, const void *);
struct Kind {
    const char *name, *create, *destroy;
};
static const Kind KINDS[] = {
    {"buffers", "vkCreateBuffer", "vkDestroyBuffer"},
    {"memory", "vkAllocateMemory", "vkFreeMemory"},
    {"fences", "vkCreateFence", "vkDestroyFence"},
    {"semaphores", "vkCreateSemaphore", "vkDestroySemaphore"},
    {"command pools", "vkCreateCommandPool", "vkDestroyCommandPool"},
    {"query pools", "vkCreateQueryPool", "vkDestroyQueryPool"},
    {"shader modules", "vkCreateShaderModule", "vkDestroyShaderModule"},
    {"pipeline layouts", "vkCreatePipelineLayout", "vkDestroyPipelineLayout"},
    {"set layouts", "vkCreateDescriptorSetLayout", "vkDestroyDescriptorSetLayout"},
    {"descriptor pools", "vkCreateDescriptorPool", "vkDestroyDescriptorPool"},
    {"pipeline caches", "vkCreatePipelineCache", "vkDestroyPipelineCache"},
};
static const size_t N = sizeof KINDS / sizeof *KINDS;
static Create real_create[N];
static Destroy real_destroy[N];
static PFN_vkCreateComputePipelines real_pipelines;
static PFN_vkDestroyPipeline real_destroy_pipeline;
static PFN_vkGetDeviceProcAddr real_device_proc;

template <size_t K> static VKAPI_ATTR VkResult VKAPI_CALL create(VkDevice d, const void *info, const void *a, void *out) {
    const VkResult result = real_create[K](d, info, a, out);
    if (result == VK_SUCCESS) count(d, KINDS[K].name, 1);
    return result;
}
template <size_t K> static VKAPI_ATTR void VKAPI_CALL destroy(VkDevice d, uint64_t object, const void *a) {
    if (object) count(d, KINDS[K].name, -1);
    real_destroy[K](d, object, a);
}
static VKAPI_ATTR VkResult VKAPI_CALL pipelines(VkDevice d, VkPipelineCache cache, uint32_t n, const VkComputePipelineCreateInfo *infos,
                                                const VkAllocationCallbacks *a, VkPipeline *out) {
    const VkResult result = real_pipelines(d, cache, n, infos, a, out);
    if (result == VK_SUCCESS) count(d, "pipelines", n);
    return result;
}
static VKAPI_ATTR void VKAPI_CALL destroy_pipeline(VkDevice d, VkPipeline pipeline, const VkAllocationCallbacks *a) {
    if (pipeline) count(d, "pipelines", -1);
    real_destroy_pipeline(d, pipeline, a);
}

template <size_t K> static bool wrapped(const char *name, PFN_vkVoidFunction real, PFN_vkVoidFunction &ours) {
    if constexpr (K < N) {
        if (!std::strcmp(name, KINDS[K].create)) {
            real_create[K] = reinterpret_cast<Create>(real);
            ours = reinterpret_cast<PFN_vkVoidFunction>(create<K>);
            return true;
        }
        if (!std::strcmp(name, KINDS[K].destroy)) {
            real_destroy[K] = reinterpret_cast<Destroy>(real);
            ours = reinterpret_cast<PFN_vkVoidFunction>(destroy<K>);
            return true;
        }
        return wrapped<K + 1>(name, real, ours);
    }
    return false;
}
static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL device_proc(VkDevice device, const char *name) {
    PFN_vkVoidFunction real = real_device_proc(device, name), ours = real;
    if (!real) return real;
    std::lock_guard<std::mutex> guard(live_lock);
    if (wrapped<0>(name, real, ours)) return ours;
    if (!std::strcmp(name, "vkCreateComputePipelines")) {
        real_pipelines = reinterpret_cast<PFN_vkCreateComputePipelines>(real);
        return reinterpret_cast<PFN_vkVoidFunction>(pipelines);
    }
    if (!std::strcmp(name, "vkDestroyPipeline")) {
        real_destroy_pipeline = reinterpret_cast<PFN_vkDestroyPipeline>(real);
        return reinterpret_cast<PFN_vkVoidFunction>(destroy_pipeline);
    }
    return real;
}
static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL instance_proc(VkInstance instance, const char *name) {
    if (!std::strcmp(name, "vkGetDeviceProcAddr")) return reinterpret_cast<PFN_vkVoidFunction>(device_proc);
    return vkGetInstanceProcAddr(instance, name);
}

// A device of the host.
struct HostDevice {
    VkInstance instance = VK_NULL_HANDLE;
    VkPhysicalDevice physical = VK_NULL_HANDLE;
    VkDevice device = VK_NULL_HANDLE;
    VkQueue queue = VK_NULL_HANDLE;
    const char *extension = VK_KHR_SYNCHRONIZATION_2_EXTENSION_NAME;
    VkPhysicalDeviceSynchronization2Features sync2{};
    VkPhysicalDeviceFeatures2 features{};

    HostDevice() {
        VkApplicationInfo application{};
        application.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO;
        application.apiVersion = VK_API_VERSION_1_2;
        VkInstanceCreateInfo info{};
        info.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO;
        info.pApplicationInfo = &application;
        uint32_t one = 1;
        if (vkCreateInstance(&info, nullptr, &instance) != VK_SUCCESS || vkEnumeratePhysicalDevices(instance, &one, &physical) < 0 || !one)
            throw std::runtime_error("no Vulkan device");
        sync2.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_SYNCHRONIZATION_2_FEATURES;
        sync2.synchronization2 = VK_TRUE;
        features.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_FEATURES_2;
        features.pNext = &sync2;
        const float priority = 1;
        VkDeviceQueueCreateInfo queues{VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO, nullptr, 0, 0, 1, &priority};
        VkDeviceCreateInfo made{};
        made.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO;
        made.pNext = &features;
        made.queueCreateInfoCount = 1;
        made.pQueueCreateInfos = &queues;
        made.enabledExtensionCount = 1;
        made.ppEnabledExtensionNames = &extension;
        if (vkCreateDevice(physical, &made, nullptr, &device) != VK_SUCCESS) throw std::runtime_error("no Vulkan device with queue family 0");
        vkGetDeviceQueue(device, 0, 0, &queue);
        real_device_proc = vkGetDeviceProcAddr;
    }
    HostDevice(const HostDevice &) = delete;
    ~HostDevice() {
        {
            std::lock_guard<std::mutex> guard(live_lock);
            for (const auto &[kind, left] : live[device])
                if (left) wrong("a context has ended and left " + std::to_string(left) + " " + kind);
            live.erase(device);
        }
        vkDestroyDevice(device, nullptr);
        vkDestroyInstance(instance, nullptr);
    }
    SvkContext *adopted() const {
        auto given = make<SvkVulkanDevice>();
        given.instance = instance;
        given.physical_device = physical;
        given.device = device;
        given.queue = queue;
        given.extension_count = 1;
        given.extensions = &extension;
        given.features = &features;
        given.get_instance_proc_addr = reinterpret_cast<SvkVoidFunction>(instance_proc);
        SvkContext *context = nullptr;
        check(svk_context_adopt(&given, nullptr, &context), context);
        return context;
    }
};

// ---- What the threads do

struct Job {
    std::string out, cameras;
    std::vector<std::vector<unsigned char>> files;
    SvkScene *shared = nullptr;
    std::chrono::steady_clock::time_point end;
};
static std::atomic<long> contexts{0}, trained{0}, cancelled{0}, answers{0}, saves{0};

// Stops the training at a call of its own choice.
struct Countdown {
    long calls = 0, stop = -1;
};
static int32_t progress(void *user, const SvkProgress *) {
    auto *countdown = static_cast<Countdown *>(user);
    return ++countdown->calls == countdown->stop;
}

static void use(SvkScene *scene, const SvkCamera &camera, bool ask) {
    const size_t pixels = size_t(camera.width) * camera.height;
    std::vector<unsigned char> image(4 * pixels), mask(pixels);
    auto colour = make<SvkOutput>();
    colour.encoding = SVK_ENCODING_UNORM8_X4;
    colour.host = image.data();
    colour.bytes = image.size();
    check(svk_scene_render(scene, &camera, &colour, 1, nullptr), scene);
    auto answer = make<SvkAnswer>();
    if (ask) check(svk_scene_query(scene, "mug", &camera, &answer, mask.data(), mask.size()), scene);
    answers++;
}

static void once(const Job &job, int number, std::mt19937 &random, long &longest) {
    std::unique_ptr<HostDevice> host;
    SvkContext *made = nullptr;
    if (contexts++ % 2) {
        host = std::make_unique<HostDevice>();
        made = host->adopted();
    } else {
        check(svk_context_create(nullptr, &made), made);
    }
    Context context(made);
    const std::vector<SvkPhoto> photos = encoded_photos(job.files);
    auto options = make<SvkTrainOptions>();
    options.preset = SVK_PRESET_DRAFT;
    options.seed = random();
    options.max_size = 160;
    options.iterations = options.language_iterations = 10;
    options.cameras = job.cameras.c_str();
    options.progress = progress;
    Countdown countdown;
    if (random() % 2) countdown.stop = 1 + long(random() % longest);
    options.user = &countdown;
    SvkScene *scene_made = nullptr;
    const SvkStatus status = svk_train(context.get(), photos.data(), photos.size(), &options, &scene_made);
    if (status == SVK_STATUS_CANCELLED && countdown.stop > 0 && !scene_made) {
        cancelled++;
    } else {
        check(status, context.get());
        longest = std::max(longest, countdown.calls);
        Scene scene(scene_made);
        trained++;
        const SvkCamera camera = scene_camera(scene.get(), 0);
        use(scene.get(), camera, true);
        const std::string place = job.out + "/" + std::to_string(number);
        for (const char *ending : {"", ".ply", ".spz"}) {
            check(svk_scene_save(scene.get(), (place + ending).c_str(), 1), scene.get());
            saves++;
        }
        SvkScene *again = nullptr;
        check(svk_scene_load(context.get(), (place + ".ply").c_str(), &again), context.get());
        use(Scene(again).get(), camera, false);
    }
    if (job.shared) use(job.shared, scene_camera(job.shared, 0), true);
}

static void thread(const Job &job, int number) {
    std::mt19937 random(number);
    long longest = 20;
    try {
        while (std::chrono::steady_clock::now() < job.end && !failed) once(job, number, random, longest);
    } catch (const std::exception &e) {
        wrong(e.what());
    }
}

// ---- What the process holds

// After the allocator has given back what is free.
static double resident_mib() {
#ifdef __GLIBC__
    malloc_trim(0);
#endif
    long pages = 0, resident = 0;
    std::ifstream("/proc/self/statm") >> pages >> resident;
    return double(resident) * double(sysconf(_SC_PAGESIZE)) / (1 << 20);
}
// Given out by malloc and not yet given back, KiB; 0 where that is not known.
static double given_out_kib() {
#if defined __GLIBC__ && (__GLIBC__ > 2 || __GLIBC_MINOR__ >= 33)
    const struct mallinfo2 info = mallinfo2();
    return double(info.uordblks + info.hblkhd) / 1024;
#else
    return 0;
#endif
}
static long entries(const char *folder) {
    long n = 0;
    DIR *d = opendir(folder);
    while (d && readdir(d)) n++;
    if (d) closedir(d);
    return n - 3;  // ".", ".." and the folder itself
}
static long objects() {
    std::lock_guard<std::mutex> guard(live_lock);
    long sum = 0;
    for (const auto &device : live)
        for (const auto &kind : device.second) sum += kind.second;
    return sum;
}

static int run(int argc, char **argv) {
    if (argc < 6) {
        std::fprintf(stderr, "usage: soak MINUTES OUT CAMERAS PHOTO PHOTO...\n");
        return 2;
    }
    Job job;
    const double seconds = 60 * std::stod(argv[1]);
    job.out = argv[2];
    job.cameras = argv[3];
    for (int i = 4; i < argc; i++) job.files.push_back(read_file(argv[i]));
#ifdef __GLIBC__
    // Other arenas of malloc keep what is free at their end, up to 64 MiB each, also from malloc_trim: what was resident grew by 169 MiB in
    // 44 contexts of which nothing was left.
    mallopt(M_ARENA_MAX, 1);
#endif
    // Once before it counts: libraries are loaded, caches are filled, and there is a scene that both threads share.
    std::mt19937 random(0);
    long longest = 1;
    job.end = std::chrono::steady_clock::now();
    for (int k = 0; k < 20 && trained < 2; k++) once(job, 0, random, longest);
    SvkContext *made = nullptr;
    check(svk_context_create(nullptr, &made), made);
    Context context(made);
    SvkScene *loaded = nullptr;
    check(svk_scene_load(context.get(), (job.out + "/0").c_str(), &loaded), context.get());
    Scene shared(loaded);
    use(shared.get(), scene_camera(shared.get(), 0), true);
    job.shared = shared.get();
    const long files = entries("/proc/self/fd");
    const auto began = std::chrono::steady_clock::now();
    job.end = began + std::chrono::milliseconds(long(1000 * seconds));
    // At the end of each round nothing is under way: what is resident then is what stays.
    struct Held {
        double resident_mib, given_out_kib;
        long contexts;
    };
    std::vector<Held> held;
    for (int round = 1; round <= ROUNDS && !failed; round++) {
        job.end = began + std::chrono::milliseconds(long(1000 * seconds * round / ROUNDS));
        std::vector<std::thread> threads;
        for (int i = 1; i <= 2; i++) threads.emplace_back(thread, std::cref(job), 2 * round + i);
        for (auto &t : threads) t.join();
        held.push_back({resident_mib(), given_out_kib(), contexts});
        const double t = std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
        std::printf("%5.0f s  %4ld contexts  %4ld trained  %4ld cancelled  %4ld rendered and asked  %4ld saved  %4.0f MiB  %8.0f KiB of malloc  %3ld files  %5ld device objects\n",
                    t, contexts.load(), trained.load(), cancelled.load(), answers.load(), saves.load(), held.back().resident_mib,
                    held.back().given_out_kib, entries("/proc/self/fd"), objects());
        std::fflush(stdout);
    }
    if (failed) return 1;
    const long files_now = entries("/proc/self/fd"), left = objects();
    const Held first = held[ROUNDS / 3], last = held.back();
    const double per_context = (last.given_out_kib - first.given_out_kib) / double(std::max(1L, last.contexts - first.contexts));
    std::printf("from round %d to the last: %.1f KiB of malloc more per context (bound: %.0f), resident %.0f and %.0f MiB (bound: %.0f MiB more); "
                "open files %ld before, %ld after; %ld device objects left\n",
                ROUNDS / 3 + 1, per_context, KIB_PER_CONTEXT, first.resident_mib, last.resident_mib, ROOM_MIB, files, files_now, left);
    if (per_context > KIB_PER_CONTEXT || last.resident_mib > first.resident_mib + ROOM_MIB) wrong("memory grows");
    if (files_now > files) wrong("open files grow");
    if (left) wrong("device objects are left");
    if (!trained || !cancelled) wrong("nothing was trained, or nothing cancelled: give it more time");
    return failed;
}

int main(int argc, char **argv) {
    try {
        return run(argc, argv);
    } catch (const std::exception &e) {
        std::fprintf(stderr, "soak: %s\n", e.what());
        return 1;
    }
}
