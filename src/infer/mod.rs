//! ONNX inference: sessions, model registry, one file per model family.
