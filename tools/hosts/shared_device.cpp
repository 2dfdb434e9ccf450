// A program with a Vulkan device of its own lets splatvk render into its image and its buffer, in order by one timeline
// semaphore and without a copy through memory; then it reads both back and compares them with what splatvk gives to memory.
//   shared_device SCENE OUT.ppm
// SPLATVK_VALIDATION=1 turns the Khronos validation layer on; any message of it fails the run.
#include "host.hpp"
#include <vulkan/vulkan.h>

#include <cmath>
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

struct Image {
    const Vulkan &v;
    VkImage raw = VK_NULL_HANDLE;
    VkDeviceMemory memory = VK_NULL_HANDLE;
    Image(const Vulkan &vulkan, uint32_t width, uint32_t height) : v(vulkan) {
        VkImageCreateInfo info{};
        info.sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO;
        info.imageType = VK_IMAGE_TYPE_2D;
        info.format = VK_FORMAT_R8G8B8A8_UNORM;
        info.extent = {width, height, 1};
        info.mipLevels = info.arrayLayers = 1;
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

// The host's own work on the image once splatvk has written it: here a copy that the host reads.
static void use(const Vulkan &v, const Image &image, const Buffer &copy, const SvkCamera &camera, uint64_t after) {
    VkCommandBufferAllocateInfo allocate{VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO, nullptr, v.pool,
                                         VK_COMMAND_BUFFER_LEVEL_PRIMARY, 1};
    VkCommandBuffer commands;
    vk(vkAllocateCommandBuffers(v.device, &allocate, &commands), "command buffer");
    VkCommandBufferBeginInfo begin{};
    begin.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO;
    vk(vkBeginCommandBuffer(commands, &begin), "begin");
    VkBufferImageCopy region{};
    region.imageSubresource = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 0, 1};
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

static void compare(const char *what, double worst, double allowed) {
    std::printf("%s: largest difference %g\n", what, worst);
    if (!(worst <= allowed)) throw std::runtime_error(std::string(what) + ": the host's memory and its device disagree");
}

static void render_and_compare(const Vulkan &v, SvkScene *scene, const char *out) {
    const SvkCamera camera = scene_camera(scene, 0);
    const size_t pixels = size_t(camera.width) * camera.height;
    Image image(v, camera.width, camera.height);
    Buffer depth(v, 4 * pixels), copy(v, 4 * pixels);
    SvkOutput outputs[2] = {make<SvkOutput>(), make<SvkOutput>()};
    outputs[0].channel = SVK_CHANNEL_COLOUR;
    outputs[0].encoding = SVK_ENCODING_UNORM8_X4;
    outputs[0].image = reinterpret_cast<uint64_t>(image.raw);
    outputs[0].layers = 1;
    outputs[0].old_layout = VK_IMAGE_LAYOUT_UNDEFINED;
    outputs[0].new_layout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL;
    outputs[1].channel = SVK_CHANNEL_DEPTH;
    outputs[1].encoding = SVK_ENCODING_F32;
    outputs[1].buffer = reinterpret_cast<uint64_t>(depth.raw);
    outputs[1].bytes = depth.bytes;
    auto sync = make<SvkSync>();
    sync.wait_semaphore = sync.signal_semaphore = reinterpret_cast<uint64_t>(v.timeline);
    sync.wait_value = 1;
    sync.signal_value = 2;
    check(svk_scene_render(scene, &camera, outputs, 2, &sync), scene);
    // Only now may the targets be written: the call has returned long before.
    uint64_t reached;
    vk(vkGetSemaphoreCounterValue(v.device, v.timeline, &reached), "counter");
    if (reached != 0) throw std::runtime_error("the targets were written before the host allowed it");
    VkSemaphoreSignalInfo signal{VK_STRUCTURE_TYPE_SEMAPHORE_SIGNAL_INFO, nullptr, v.timeline, 1};
    vk(vkSignalSemaphore(v.device, &signal), "signal");
    use(v, image, copy, camera, 2);
    check(svk_scene_wait(scene), scene);

    std::vector<unsigned char> colour(4 * pixels);
    std::vector<float> z(pixels);
    for (SvkOutput &o : outputs) o.image = o.buffer = 0;
    outputs[0].host = colour.data();
    outputs[0].bytes = colour.size();
    outputs[1].host = z.data();
    outputs[1].bytes = 4 * z.size();
    check(svk_scene_render(scene, &camera, outputs, 2, nullptr), scene);
    const auto got = copy.read<unsigned char>();
    const auto got_z = depth.read<float>();
    double worst = 0, worst_z = 0, most = 0;
    for (size_t i = 0; i < got.size(); i++) {
        worst = std::fmax(worst, std::abs(int(got[i]) - int(colour[i])));
        most = std::fmax(most, colour[i]);
    }
    for (size_t i = 0; i < z.size(); i++) worst_z = std::fmax(worst_z, std::fabs(got_z[i] - z[i]));
    // The same passes on the same device, twice: the same bits.
    compare("colour", worst, 0);
    compare("depth", worst_z, 0);
    if (most < 64) throw std::runtime_error("the image is black");
    write_ppm(out, camera.width, camera.height, got.data());
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
            render_and_compare(v, scene.get(), argv[2]);
        }
        std::printf("%s is written; %d validation messages\n", argv[2], messages);
        return messages ? 1 : 0;
    } catch (const std::exception &e) {
        std::fprintf(stderr, "shared_device: %s\n", e.what());
        return 1;
    }
}
