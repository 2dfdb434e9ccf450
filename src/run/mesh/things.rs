//! Labels of pixels by the things of a scene.
use crate::gpu::Device;
use crate::pass::renderer::Renderer;
use crate::scene::{Camera, Image, SH_C0, Splats};
use crate::{Error, Result};

/// The things that splats belong to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Things {
    /// [N] number of the thing of every splat: k for `names[k - 1]`, 0 = none.
    pub object: Vec<u32>,
    /// Names.
    pub names: Vec<String>,
}

impl Things {
    /// Name of a thing by its number, from 1.
    pub fn name(&self, number: u32) -> &str {
        self.names.get((number as usize).wrapping_sub(1)).map_or("", String::as_str)
    }
}

/// Things that are rendered at once, one per colour channel.
const AT_ONCE: usize = 3;

/// Renders the number of the thing that covers most of a pixel.
pub(super) struct ThingLabels(Vec<Renderer>);

impl ThingLabels {
    /// Uploads the scene with a channel per thing: 1 on its splats and 0 on the others.
    ///
    /// # Errors
    /// Bad input for another number of splats and for numbers without a name.
    pub fn new(device: &Device, splats: &Splats, things: &Things) -> Result<ThingLabels> {
        let unnamed = things.object.iter().any(|k| *k as usize > things.names.len());
        if things.object.len() != splats.len() || unnamed {
            return Err(Error::input("the things do not fit the splats of the scene; find them again"));
        }
        let renderers = (0..things.names.len()).step_by(AT_ONCE).map(|first| {
            let share = |own: u32, channel: usize| f32::from(u8::from(own as usize == first + channel + 1));
            let sh = things.object.iter().flat_map(|k| [0, 1, 2].map(|c| (share(*k, c) - 0.5) / SH_C0));
            let shown = Splats { sh: sh.collect(), sh_degree: 0, ..splats.clone() };
            Renderer::new(device, &shown, &[], 0)
        });
        Ok(ThingLabels(renderers.collect::<Result<_>>()?))
    }

    /// [H, W] number of the thing with the largest blended share; 0 where splats of none have more.
    pub fn view(&mut self, camera: &Camera, alpha: &Image<f32>) -> Result<Image<u32>> {
        let mut rest = alpha.clone();
        let mut best = Image::filled(alpha.width, alpha.height, (0, 0.0));
        for (group, renderer) in self.0.iter_mut().enumerate() {
            let shares = renderer.render(camera)?.rgb;
            for (i, pixel) in shares.data.iter().enumerate() {
                for (channel, share) in pixel.iter().enumerate() {
                    rest.data[i] -= share;
                    if *share > best.data[i].1 {
                        best.data[i] = ((group * AT_ONCE + channel + 1) as u32, *share);
                    }
                }
            }
        }
        let label = |((thing, share), rest): (&(u32, f32), &f32)| if share >= rest { *thing } else { 0 };
        let data = best.data.iter().zip(&rest.data).map(label).collect();
        Ok(Image { width: alpha.width, height: alpha.height, data })
    }
}
