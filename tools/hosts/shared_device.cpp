// A program with a Vulkan device of its own lets splatvk render into its images and buffers, in order by one timeline
// semaphore and without a copy through memory; then it reads both back and compares them with what splatvk gives to memory.
//   shared_device SCENE OUT.ppm
// SPLATVK_VALIDATION=1 turns the Khronos validation layer on; any message of it fails the run.
#include "host.hpp"
#include <vulkan/vulkan.h>

#include <cstdlib>
#include <cstring>

static int messages = 0;

static void vk(VkResult result, const char *what) {
    if (result != VK_SUCCESS) throw std::runtime_error(std::string(what) + ": VkResult " + std::to_string(result));
}

static VKAPI_ATTR VkBool32 VKAPI_CALL heard(VkDebugUtilsMessageSeverityFlagBitsEXT, VkDebugUtilsMessageTypeFlagsEXT,
                                            const VkDebugUtilsMessengerCallbackDataEXT *data, void *) {
    std::fprintf(stderr, "validation: %s\n", data->pMessage);
    messages++;
    return VK_FALSE;
}

// The host's Vulkan objects; a real program has them already.
struct Vulkan {
    VkInstance instance = VK_NULL_HANDLE;
    VkDebugUtilsMessengerEXT messenger = VK_NULL_HANDLE;
    VkPhysicalDevice physical = VK_NULL_HANDLE;
    VkDevice device = VK_NULL_HANDLE;
    VkQueue queue = VK_NULL_HANDLE;
    VkCommandPool pool = VK_NULL_HANDLE;
    VkSemaphore timeline = VK_NULL_HANDLE;
    uint32_t family = 0;
    // What the device was made with, for splatvk to read.
    VkPhysicalDeviceSynchronization2Features sync2{};
    VkPhysicalDeviceVulkan12Features v12{};
    VkPhysicalDeviceFeatures2 features{};
    std::vector<const char *> extensions{VK_KHR_SYNCHRONIZATION_2_EXTENSION_NAME};

    Vulkan() {
        make_instance();
        make_device();
        VkCommandPoolCreateInfo pool_info{VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO, nullptr, 0, family};
        vk(vkCreateCommandPool(device, &pool_info, nullptr, &pool), "command pool");
        VkSemaphoreTypeCreateInfo type{VK_STRUCTURE_TYPE_SEMAPHORE_TYPE_CREATE_INFO, nullptr, VK_SEMAPHORE_TYPE_TIMELINE, 0};
        VkSemaphoreCreateInfo semaphore{VK_STRUCTURE_TYPE_SEMAPHORE_CREATE_INFO, &type, 0};
        vk(vkCreateSemaphore(device, &semaphore, nullptr, &timeline), "semaphore");
    }
    Vulkan(const Vulkan &) = delete;
    ~Vulkan() {
        vkDeviceWaitIdle(device);
        vkDestroySemaphore(device, timeline, nullptr);
        vkDestroyCommandPool(device, pool, nullptr);
        vkDestroyDevice(device, nullptr);
        auto end = reinterpret_cast<PFN_vkDestroyDebugUtilsMessengerEXT>(
            vkGetInstanceProcAddr(instance, "vkDestroyDebugUtilsMessengerEXT"));
        if (messenger) end(instance, messenger, nullptr);
        vkDestroyInstance(instance, nullptr);
    }

    void make_instance() {
        const char *asked = std::getenv("SPLATVK_VALIDATION");
        const bool validate = asked && !std::strcmp(asked, "1");
        VkApplicationInfo application{};
        application.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO;
        application.apiVersion = VK_API_VERSION_1_2;
        const char *layer = "VK_LAYER_KHRONOS_validation", *debug = VK_EXT_DEBUG_UTILS_EXTENSION_NAME;
        VkInstanceCreateInfo info{};
        info.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO;
        info.pApplicationInfo = &application;
        info.enabledLayerCount = info.enabledExtensionCount = validate ? 1 : 0;
        info.ppEnabledLayerNames = &layer;
        info.ppEnabledExtensionNames = &debug;
        vk(vkCreateInstance(&info, nullptr, &instance), "instance");
        if (!validate) return;
        VkDebugUtilsMessengerCreateInfoEXT hear{};
        hear.sType = VK_STRUCTURE_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT;
        hear.messageSeverity =
            VK_DEBUG_UTILS_MESSAGE_SEVERITY_ERROR_BIT_EXT | VK_DEBUG_UTILS_MESSAGE_SEVERITY_WARNING_BIT_EXT;
        hear.messageType =
            VK_DEBUG_UTILS_MESSAGE_TYPE_VALIDATION_BIT_EXT | VK_DEBUG_UTILS_MESSAGE_TYPE_PERFORMANCE_BIT_EXT;
        hear.pfnUserCallback = heard;
        auto make_messenger = reinterpret_cast<PFN_vkCreateDebugUtilsMessengerEXT>(
            vkGetInstanceProcAddr(instance, "vkCreateDebugUtilsMessengerEXT"));
        vk(make_messenger(instance, &hear, nullptr, &messenger), "messenger");
    }

    void make_device() {
        uint32_t count = 1;
        if (vkEnumeratePhysicalDevices(instance, &count, &physical) < 0 || count == 0)
            throw std::runtime_error("no Vulkan device");
        uint32_t families = 0;
        vkGetPhysicalDeviceQueueFamilyProperties(physical, &families, nullptr);
        std::vector<VkQueueFamilyProperties> list(families);
        vkGetPhysicalDeviceQueueFamilyProperties(physical, &families, list.data());
        while (family < families && !(list[family].queueFlags & VK_QUEUE_COMPUTE_BIT)) family++;
        sync2.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_SYNCHRONIZATION_2_FEATURES;
        sync2.synchronization2 = VK_TRUE;
        v12.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_2_FEATURES;
        v12.pNext = &sync2;
        v12.timelineSemaphore = VK_TRUE;
        features.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_FEATURES_2;
        features.pNext = &v12;
        // On a GPU a real host also turns on what SvkVulkanDevice.features lists, where the device offers it.
        const float priority = 1;
        VkDeviceQueueCreateInfo queues{VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO, nullptr, 0, family, 1, &priority};
        VkDeviceCreateInfo info{};
        info.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO;
        info.pNext = &features;
        info.queueCreateInfoCount = 1;
        info.pQueueCreateInfos = &queues;
        info.enabledExtensionCount = static_cast<uint32_t>(extensions.size());
        info.ppEnabledExtensionNames = extensions.data();
        vk(vkCreateDevice(physical, &info, nullptr, &device), "device");
        vkGetDeviceQueue(device, family, 0, &queue);
    }

    uint32_t memory_type(uint32_t allowed, VkMemoryPropertyFlags wanted) const {
        VkPhysicalDeviceMemoryProperties memory;
        vkGetPhysicalDeviceMemoryProperties(physical, &memory);
        for (uint32_t i = 0; i < memory.memoryTypeCount; i++)
            if (allowed >> i & 1 && (memory.memoryTypes[i].propertyFlags & wanted) == wanted) return i;
        throw std::runtime_error("no suitable memory");
    }
    VkDeviceMemory allocate(const VkMemoryRequirements &needs, VkMemoryPropertyFlags wanted) const {
        VkMemoryAllocateInfo info{VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO, nullptr, needs.size,
                                  memory_type(needs.memoryTypeBits, wanted)};
        VkDeviceMemory memory;
        vk(vkAllocateMemory(device, &info, nullptr, &memory), "memory");
        return memory;
    }
};

// A buffer that the host can read.
struct Buffer {
    const Vulkan &v;
    VkDeviceSize bytes;
    VkBuffer raw = VK_NULL_HANDLE;
    VkDeviceMemory memory = VK_NULL_HANDLE;
    Buffer(const Vulkan &vulkan, VkDeviceSize size) : v(vulkan), bytes(size) {
        VkBufferCreateInfo info{};
        info.sType = VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO;
        info.size = size;
        info.usage = VK_BUFFER_USAGE_TRANSFER_DST_BIT;
        vk(vkCreateBuffer(v.device, &info, nullptr, &raw), "buffer");
        VkMemoryRequirements needs;
        vkGetBufferMemoryRequirements(v.device, raw, &needs);
        memory = v.allocate(needs, VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT);
        vk(vkBindBufferMemory(v.device, raw, memory, 0), "bind");
    }
    Buffer(const Buffer &) = delete;
    ~Buffer() {
        vkDestroyBuffer(v.device, raw, nullptr);
        vkFreeMemory(v.device, memory, nullptr);
    }
    template <typename T> std::vector<T> read() const {
        void *mapped;
        vk(vkMapMemory(v.device, memory, 0, VK_WHOLE_SIZE, 0, &mapped), "map");
        const T *first = static_cast<const T *>(mapped);
        std::vector<T> values(first, first + bytes / sizeof(T));
        vkUnmapMemory(v.device, memory);
        return values;
    }
};

// What is asked of the scene, and the image of the host that holds it.
struct Target {
    const char *name;
    SvkChannel channel;
    SvkEncoding encoding;
    uint32_t level;
    const char *text;
    VkFormat format;
    uint32_t layers;
    size_t pixel_bytes;
};

struct Image {
    const Vulkan &v;
    VkImage raw = VK_NULL_HANDLE;
    VkDeviceMemory memory = VK_NULL_HANDLE;
    Image(const Vulkan &vulkan, const SvkCamera &camera, const Target &target) : v(vulkan) {
        VkImageCreateInfo info{};
        info.sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO;
        info.imageType = VK_IMAGE_TYPE_2D;
        info.format = target.format;
        info.extent = {camera.width, camera.height, 1};
        info.mipLevels = 1;
        info.arrayLayers = target.layers;
        info.samples = VK_SAMPLE_COUNT_1_BIT;
        info.tiling = VK_IMAGE_TILING_OPTIMAL;
        info.usage = VK_IMAGE_USAGE_TRANSFER_DST_BIT | VK_IMAGE_USAGE_TRANSFER_SRC_BIT;
        vk(vkCreateImage(v.device, &info, nullptr, &raw), "image");
        VkMemoryRequirements needs;
        vkGetImageMemoryRequirements(v.device, raw, &needs);
        memory = v.allocate(needs, 0);
        vk(vkBindImageMemory(v.device, raw, memory, 0), "bind");
    }
    Image(const Image &) = delete;
    ~Image() {
        vkDestroyImage(v.device, raw, nullptr);
        vkFreeMemory(v.device, memory, nullptr);
    }
};

// The host's own work on an image once splatvk has written it: here a copy that the host reads.
static void use(const Vulkan &v, const Image &image, uint32_t layers, const Buffer &copy, const SvkCamera &camera,
                uint64_t after) {
    VkCommandBufferAllocateInfo allocate{VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO, nullptr, v.pool,
                                         VK_COMMAND_BUFFER_LEVEL_PRIMARY, 1};
    VkCommandBuffer commands;
    vk(vkAllocateCommandBuffers(v.device, &allocate, &commands), "command buffer");
    VkCommandBufferBeginInfo begin{};
    begin.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO;
    vk(vkBeginCommandBuffer(commands, &begin), "begin");
    VkBufferImageCopy region{};
    region.imageSubresource = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 0, layers};
    region.imageExtent = {camera.width, camera.height, 1};
    vkCmdCopyImageToBuffer(commands, image.raw, VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL, copy.raw, 1, &region);
    VkMemoryBarrier readable{VK_STRUCTURE_TYPE_MEMORY_BARRIER, nullptr, VK_ACCESS_TRANSFER_WRITE_BIT, VK_ACCESS_HOST_READ_BIT};
    vkCmdPipelineBarrier(commands, VK_PIPELINE_STAGE_TRANSFER_BIT, VK_PIPELINE_STAGE_HOST_BIT, 0, 1, &readable, 0, nullptr, 0,
                         nullptr);
    vk(vkEndCommandBuffer(commands), "end");
    const uint64_t done = after + 1;
    VkTimelineSemaphoreSubmitInfo values{};
    values.sType = VK_STRUCTURE_TYPE_TIMELINE_SEMAPHORE_SUBMIT_INFO;
    values.waitSemaphoreValueCount = values.signalSemaphoreValueCount = 1;
    values.pWaitSemaphoreValues = &after;
    values.pSignalSemaphoreValues = &done;
    const VkPipelineStageFlags stage = VK_PIPELINE_STAGE_TRANSFER_BIT;
    VkSubmitInfo submit{};
    submit.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO;
    submit.pNext = &values;
    submit.waitSemaphoreCount = submit.signalSemaphoreCount = submit.commandBufferCount = 1;
    submit.pWaitSemaphores = submit.pSignalSemaphores = &v.timeline;
    submit.pWaitDstStageMask = &stage;
    submit.pCommandBuffers = &commands;
    vk(vkQueueSubmit(v.queue, 1, &submit, VK_NULL_HANDLE), "submit");
    VkSemaphoreWaitInfo wait{VK_STRUCTURE_TYPE_SEMAPHORE_WAIT_INFO, nullptr, 0, 1, &v.timeline, &done};
    vk(vkWaitSemaphores(v.device, &wait, UINT64_MAX), "wait");
    vkFreeCommandBuffers(v.device, v.pool, 1, &commands);
}

static Context adopt(const Vulkan &v) {
    auto given = make<SvkVulkanDevice>();
    given.instance = v.instance;
    given.physical_device = v.physical;
    given.device = v.device;
    given.queue = v.queue;
    given.queue_family = v.family;
    given.extensions = v.extensions.data();
    given.extension_count = static_cast<uint32_t>(v.extensions.size());
    given.features = &v.features;
    given.get_instance_proc_addr = reinterpret_cast<SvkVoidFunction>(vkGetInstanceProcAddr);
    SvkContext *context = nullptr;
    check(svk_context_adopt(&given, nullptr, &context), context);
    return Context(context);
}

// Into an image and a buffer of the host, only when it allows it; then into memory: the same
// passes on the same device give the same bits. `clock` is what the timeline has reached.
static std::vector<unsigned char> render_and_compare(const Vulkan &v, SvkScene *scene, const SvkCamera &camera,
                                                     const Target &target, uint64_t &clock) {
    const size_t bytes = target.pixel_bytes * target.layers * camera.width * camera.height;
    Image image(v, camera, target);
    Buffer buffer(v, bytes), copy(v, bytes);
    SvkOutput outputs[2] = {make<SvkOutput>(), make<SvkOutput>()};
    for (SvkOutput &o : outputs) {
        o.channel = target.channel;
        o.encoding = target.encoding;
        o.level = target.level;
        o.text = target.text;
    }
    outputs[0].image = reinterpret_cast<uint64_t>(image.raw);
    outputs[0].layers = target.layers;
    outputs[0].old_layout = VK_IMAGE_LAYOUT_UNDEFINED;
    outputs[0].new_layout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL;
    outputs[1].buffer = reinterpret_cast<uint64_t>(buffer.raw);
    outputs[1].bytes = bytes;
    auto sync = make<SvkSync>();
    sync.wait_semaphore = sync.signal_semaphore = reinterpret_cast<uint64_t>(v.timeline);
    sync.wait_value = clock + 1;
    sync.signal_value = clock + 2;
    check(svk_scene_render(scene, &camera, outputs, 2, &sync), scene);
    // Only now may the targets be written: the call has returned long before.
    uint64_t reached;
    vk(vkGetSemaphoreCounterValue(v.device, v.timeline, &reached), "counter");
    if (reached != clock) throw std::runtime_error("the targets were written before the host allowed it");
    VkSemaphoreSignalInfo signal{VK_STRUCTURE_TYPE_SEMAPHORE_SIGNAL_INFO, nullptr, v.timeline, clock + 1};
    vk(vkSignalSemaphore(v.device, &signal), "signal");
    use(v, image, target.layers, copy, camera, clock + 2);
    clock += 3;
    check(svk_scene_wait(scene), scene);

    std::vector<unsigned char> memory(bytes);
    outputs[0].image = 0;
    outputs[0].host = memory.data();
    outputs[0].bytes = bytes;
    check(svk_scene_render(scene, &camera, outputs, 1, nullptr), scene);
    size_t other = 0, set = 0;
    const auto in_image = copy.read<unsigned char>(), in_buffer = buffer.read<unsigned char>();
    for (size_t i = 0; i < bytes; i++) {
        other += in_image[i] != memory[i] || in_buffer[i] != memory[i];
        set += memory[i] != 0;
    }
    std::printf("%s: %zu of %zu bytes differ\n", target.name, other, bytes);
    if (other) throw std::runtime_error(std::string(target.name) + ": the host's memory and its device disagree");
    if (set < bytes / 8) throw std::runtime_error(std::string(target.name) + ": nearly nothing is there");
    return memory;
}

static void render_all(const Vulkan &v, SvkScene *scene, const char *out) {
    const SvkCamera camera = scene_camera(scene, 0);
    auto info = make<SvkSceneInfo>();
    check(svk_scene_info(scene, &info), scene);
    uint32_t level = 2;
    while (level > 0 && !info.codes[level]) level--;
    const uint32_t layers = (info.feature_dim[level] + 3) / 4;
    const Target targets[] = {
        {"colour", SVK_CHANNEL_COLOUR, SVK_ENCODING_UNORM8_X4, 0, nullptr, VK_FORMAT_R8G8B8A8_UNORM, 1, 4},
        {"depth", SVK_CHANNEL_DEPTH, SVK_ENCODING_F32, 0, nullptr, VK_FORMAT_R32_SFLOAT, 1, 4},
        {"features", SVK_CHANNEL_FEATURES, SVK_ENCODING_F16X4, level, nullptr, VK_FORMAT_R16G16B16A16_SFLOAT, layers, 8},
        {"features", SVK_CHANNEL_FEATURES, SVK_ENCODING_F32X4, level, nullptr, VK_FORMAT_R32G32B32A32_SFLOAT, layers, 16},
        {"relevancy", SVK_CHANNEL_RELEVANCY, SVK_ENCODING_F32, 0, "lemon", VK_FORMAT_R32_SFLOAT, 1, 4},
    };
    uint64_t clock = 0;
    for (const Target &target : targets) {
        const auto bytes = render_and_compare(v, scene, camera, target, clock);
        if (target.channel == SVK_CHANNEL_COLOUR) write_ppm(out, camera.width, camera.height, bytes.data());
    }
}

int main(int argc, char **argv) {
    if (argc != 3) {
        std::fprintf(stderr, "usage: shared_device SCENE OUT.ppm\n");
        return 2;
    }
    try {
        Vulkan v;
        // Context and scene end before the device.
        {
            Context context = adopt(v);
            SvkScene *loaded = nullptr;
            check(svk_scene_load(context.get(), argv[1], &loaded), context.get());
            Scene scene(loaded);
            render_all(v, scene.get(), argv[2]);
        }
        std::printf("%s is written; %d validation messages\n", argv[2], messages);
        return messages ? 1 : 0;
    } catch (const std::exception &e) {
        std::fprintf(stderr, "shared_device: %s\n", e.what());
        return 1;
    }
}
