//! The Vulkan engine.
