//! Image quality figures on the CPU.
use super::ssim_l1::ssim_l1;
use crate::scene::RgbImage;

/// Peak signal-to-noise ratio in dB of two equally sized images; colours are clipped to [0, 1] as a
/// viewer would.
pub fn psnr(rendered: &RgbImage, target: &RgbImage) -> f64 {
    psnr_masked(rendered, target, |_| true)
}

/// [`psnr`] over the pixels for which `keep(index)` holds; infinite for equal images.
pub fn psnr_masked(rendered: &RgbImage, target: &RgbImage, keep: impl Fn(usize) -> bool) -> f64 {
    let (mut sum, mut count) = (0.0f64, 0usize);
    for (i, (a, b)) in rendered.data.iter().zip(&target.data).enumerate() {
        if keep(i) {
            sum += (0..3).map(|c| (a[c].clamp(0.0, 1.0) - b[c].clamp(0.0, 1.0)).powi(2) as f64).sum::<f64>();
            count += 3;
        }
    }
    -10.0 * (sum / count.max(1) as f64).log10()
}

/// Mean SSIM of two equally sized images (window and constants of [`super::ssim_l1`]).
pub fn ssim(rendered: &RgbImage, target: &RgbImage) -> f64 {
    let x: Vec<f64> = planar(rendered).iter().map(|v| v.clamp(0.0, 1.0) as f64).collect();
    let y: Vec<f64> = planar(target).iter().map(|v| v.clamp(0.0, 1.0) as f64).collect();
    ssim_l1(&x, &y, rendered.width, rendered.height, 0.0, 1.0).0.ssim
}

/// `[H, W, 3]` → planar `[3, H, W]`, the order of images on the GPU.
pub fn planar(image: &RgbImage) -> Vec<f32> {
    (0..3).flat_map(|c| image.data.iter().map(move |p| p[c])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_constant_offset_matches_formula() {
        let target = RgbImage { width: 4, height: 3, data: vec![[0.25; 3]; 12] };
        let rendered = RgbImage { data: vec![[0.35; 3]; 12], ..target.clone() };
        assert!((psnr(&rendered, &target) - 20.0).abs() < 1e-4);
        assert!(psnr(&target, &target).is_infinite());
        assert!((ssim(&target, &target) - 1.0).abs() < 1e-12);
        // Colours beyond white and black are clipped.
        let target = RgbImage { data: vec![[1.0, 0.0, 0.25]; 12], ..target };
        let rendered = RgbImage { data: vec![[7.0, -3.0, 0.25]; 12], ..target.clone() };
        assert!(psnr(&rendered, &target).is_infinite());
    }
}
