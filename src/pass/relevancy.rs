//! Relevancy per pixel from the score of the code that decodes it.
use crate::gpu::{Buffer, Recorder, shaders};

/// `relevancy[p] = scores[codes[p]]`, 0 where the code is −1; `codes` is `[pixels]` of `i32`, `scores` `[K]`.
/// Twin: [`relevancy_of`].
pub fn record(rec: &mut Recorder, codes: &Buffer, scores: &Buffer, relevancy: &Buffer, pixels: u32) {
    rec.dispatch_threads(
        shaders::relevancy_map::call(
            &shaders::relevancy_map::Bindings { codes, scores, relevancy },
            &shaders::relevancy_map::Push { pixels },
        ),
        [pixels, 1, 1],
    );
}

/// Twin of [`record`].
pub fn relevancy_of(codes: &[i32], scores: &[f32]) -> Vec<f32> {
    codes.iter().map(|&k| usize::try_from(k).map_or(0.0, |k| scores[k])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::test_device;

    #[test]
    fn equals_its_twin() {
        let device = test_device();
        let codes: Vec<i32> = (0..1001).map(|i| i % 8 - 1).collect();
        let scores = [0.1f32, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7];
        let codes_buffer = device.buffer_from("codes", &codes).unwrap();
        let scores_buffer = device.buffer_from("scores", &scores).unwrap();
        let relevancy = device.buffer::<f32>("relevancy", codes.len()).unwrap();
        let mut rec = Recorder::new(&device, "relevancy");
        record(&mut rec, &codes_buffer, &scores_buffer, &relevancy, codes.len() as u32);
        rec.run().unwrap();
        assert_eq!(relevancy.read::<f32>().unwrap(), relevancy_of(&codes, &scores));
    }
}
