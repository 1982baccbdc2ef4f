//! The noise of the C51 head's noisy layers: factorised Gaussian noise, one number per input and output of a layer.
//! This module knows no weights and no seeds.
//!
//! Source: Fortunato et al. 2018, section 3.1 (b).

use rand_chacha::ChaCha8Rng;

use crate::config::ModelConfig;
use crate::init::draw_normals;

/// One draw of the noise of all noisy layers of a head.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadNoise {
    /// One entry per layer, in the order of the head's layers.
    pub(crate) layers: Vec<LayerNoise>,
}

/// f(eps) of one layer, with f(x) = sgn(x) sqrt|x|. A weight's noise is its output's times its input's, a bias's is its output's.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct LayerNoise {
    pub(crate) inputs: Vec<f64>,
    pub(crate) outputs: Vec<f64>,
}

impl HeadNoise {
    /// Draws noise for the head of `config`; `None` if the head has no noisy layer.
    pub fn draw(config: &ModelConfig, rng: &mut ChaCha8Rng) -> Option<Self> {
        let drawn = Self::from_normals(config, |_, _, len| Ok::<_, ()>(draw_normals(len, rng)));
        drawn.unwrap_or_default()
    }

    /// Builds noise from standard normal numbers. `normals` receives a layer's name, `in` or `out`, and the
    /// count, and returns the numbers. Returns `None` for a head without noisy layers.
    pub fn from_normals<E>(
        config: &ModelConfig,
        mut normals: impl FnMut(&str, &str, usize) -> Result<Vec<f64>, E>,
    ) -> Result<Option<Self>, E> {
        if config.head.noisy_sigma.is_none() {
            return Ok(None);
        }
        let mut scaled = |layer: &str, side: &str, len: usize| -> Result<Vec<f64>, E> {
            let normals = normals(layer, side, len)?;
            assert_eq!(normals.len(), len, "noise of {layer}");
            let f = |x: f64| x.signum() * x.abs().sqrt();
            Ok(normals.into_iter().map(f).collect())
        };
        let mut layers = Vec::new();
        for (name, outputs) in config.head_layers() {
            layers.push(LayerNoise {
                inputs: scaled(name, "in", config.hidden)?,
                outputs: scaled(name, "out", outputs)?,
            });
        }
        Ok(Some(Self { layers }))
    }

    /// Returns the noise of the weight [out, in] and the bias [out] of the head's layer with this index.
    pub fn weight_and_bias(&self, index: usize) -> (Vec<f64>, Vec<f64>) {
        let LayerNoise { inputs, outputs } = &self.layers[index];
        let mut weight = Vec::with_capacity(inputs.len() * outputs.len());
        for output in outputs {
            weight.extend(inputs.iter().map(|input| input * output));
        }
        (weight, outputs.clone())
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::rand_core::SeedableRng;

    use super::*;
    use crate::HeadConfig;

    /// f(eps) has mean 0 and E f^2 = E|eps| = sqrt(2 / pi). Moments of a product are products of moments. Layers are independent.
    #[test]
    fn it_has_the_moments_of_the_paper_s_noise() {
        let config = ModelConfig {
            atoms: 7,
            hidden: 11,
            head: HeadConfig::RAINBOW,
            ..ModelConfig::small()
        };
        let rng = &mut ChaCha8Rng::seed_from_u64(2);
        let mut moments = [0.0; 4];
        let mut count = 0.0;
        for _ in 0..2000 {
            let noise = HeadNoise::draw(&config, rng).unwrap();
            let (value, value_bias) = noise.weight_and_bias(0);
            let (advantage, bias) = noise.weight_and_bias(1);
            assert_eq!((value.len(), advantage.len()), (77, 231));
            assert_eq!((value_bias.len(), bias.len()), (7, 21));
            for (v, a) in [(value[0], advantage[0]), (value[76], advantage[230])] {
                for (moment, it) in moments.iter_mut().zip([v, v * v, a * a, v * a]) {
                    *moment += it;
                }
                count += 1.0;
            }
        }
        let [mean, square_v, square_a, together] = moments.map(|sum| sum / count);
        let square = 2.0 / std::f64::consts::PI;
        let is_even = mean.abs() < 0.06 && together.abs() < 0.06;
        assert!(is_even, "{mean}, {together}");
        for found in [square_v, square_a] {
            assert!((found - square).abs() < 0.1, "{found}, not {square}");
        }
    }
}
