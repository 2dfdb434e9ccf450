//! Toy networks with the interfaces of real ones, and a photo for them.
use crate::onnx::{Attribute, FLOAT, INT64, Onnx};
use splatvk_io::photo::{self, Photo};
use splatvk_types::scene::RgbImage;
use std::path::Path;

/// Mean colour of the image as embedding.
pub fn image_tower() -> Onnx {
    Onnx::new().input("pixel_values", FLOAT, "batch 3 16 16").output("image_embeds", "batch 3").node(
        "ReduceMean",
        "pixel_values",
        "image_embeds",
        &[("axes", Attribute::Ints(&[2, 3])), ("keepdims", Attribute::Int(0))],
    )
}

pub const WORDS: [&str; 12] =
    ["[UNK]", "red", "green", "blue", "dog", "city", "page", "text", "person", "bicycle", "plate", "food"];

/// Sum of the rows of the words: red, green and blue point along their channel, other words and
/// padding in a neutral direction.
pub fn text_tower(order: [usize; 3]) -> Onnx {
    let mut table = vec![0.01f32; 3 * WORDS.len()];
    for (k, channel) in order.into_iter().enumerate() {
        table[3 * (k + 1) + channel] = 100.0;
    }
    Onnx::new()
        .input("input_ids", INT64, "1 8")
        .output("text_embeds", "1 3")
        .weight("table", &[WORDS.len() as u64, 3], &table)
        .integers("axis", &[1])
        .node("Gather", "table input_ids", "rows", &[])
        .node("ReduceSum", "rows axis", "text_embeds", &[("keepdims", Attribute::Int(0))])
}

pub fn tokenizer() -> String {
    let vocabulary: Vec<String> = WORDS.iter().enumerate().map(|(i, w)| format!("\"{w}\": {i}")).collect();
    format!(
        r#"{{"version": "1.0", "truncation": null, "padding": null, "added_tokens": [], "normalizer": {{"type": "Lowercase"}},
            "pre_tokenizer": {{"type": "Whitespace"}}, "post_processor": null, "decoder": null,
            "model": {{"type": "WordLevel", "vocab": {{{}}}, "unk_token": "[UNK]"}}}}"#,
        vocabulary.join(", ")
    )
}

pub fn clip_in(folder: &Path, order: [usize; 3]) {
    image_tower().write(&folder.join("clip_toy/vision_model.onnx"));
    text_tower(order).write(&folder.join("clip_toy/text_model.onnx"));
    std::fs::write(folder.join("clip_toy/tokenizer.json"), tokenizer()).unwrap();
}

pub fn photo(stem: &str, image: RgbImage) -> Photo {
    photo::of_image(format!("{stem}.png").as_ref(), image)
}
